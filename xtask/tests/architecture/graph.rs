//! Which modules of a crate use which, read from its sources.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque, btree_map::Entry},
    fs,
    path::{Path, PathBuf},
};

use proc_macro2::{TokenStream, TokenTree};
use syn::{
    Attribute, ImplItem, Item, ItemUse, Macro, UseTree, Visibility,
    visit::{self, Visit},
};

/// Imports that lead from one to the next, at most: a chain longer than this goes round in a circle.
const LONGEST_CHAIN: usize = 16;

/// The modules of a crate, the root first.
pub(crate) struct ModuleGraph {
    modules: Vec<Module>,
}

#[derive(Default)]
struct Module {
    /// `a::b`; empty for the root.
    name: String,
    parent: usize,
    children: BTreeMap<String, usize>,
    /// Names of the items that it defines.
    defined: BTreeSet<String>,
    imports: Vec<Import>,
    /// Paths that its code names.
    paths: BTreeSet<Vec<String>>,
}

/// A name that `use` brings into a module.
struct Import {
    /// None for `*`.
    name: Option<String>,
    path: Vec<String>,
    is_re_export: bool,
}

/// What a path leads to.
struct Target {
    module: usize,
    /// The item in the module; none for the module itself.
    item: Option<String>,
}

impl ModuleGraph {
    /// Reads a crate from its root file on.
    pub(crate) fn read(root: &Path) -> Self {
        let mut graph = Self {
            modules: vec![Module::default()],
        };
        let folder = root.parent().unwrap();
        graph.read_file(0, root, folder);
        graph
    }

    fn read_file(&mut self, module: usize, file: &Path, folder: &Path) {
        let text = fs::read_to_string(file).unwrap();
        let parsed =
            syn::parse_file(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        self.read_items(module, &parsed.items, folder);
    }

    /// `folder` holds the files of the module's children.
    fn read_items(&mut self, module: usize, items: &[Item], folder: &Path) {
        for item in items {
            let Item::Mod(child) = item else {
                self.modules[module].defined.extend(defined_names(item));
                Reader(&mut self.modules[module]).visit_item(item);
                continue;
            };
            if only_for_tests(&child.attrs) {
                continue;
            }
            let name = child.ident.to_string();
            let index = self.add(module, &name);
            let folder = folder.join(&name);
            match &child.content {
                Some((_, items)) => self.read_items(index, items, &folder),
                None => self.read_file(index, &module_file(&folder), &folder),
            }
        }
    }

    fn add(&mut self, parent: usize, name: &str) -> usize {
        let index = self.modules.len();
        let above = &mut self.modules[parent];
        above.children.insert(name.to_owned(), index);
        let full = match above.name.as_str() {
            "" => name.to_owned(),
            above => format!("{above}::{name}"),
        };
        self.modules.push(Module {
            name: full,
            parent,
            ..Module::default()
        });
        index
    }

    /// The circles, one line each: who uses what of whom.
    pub(crate) fn circles(&self) -> Vec<String> {
        let edges: Vec<BTreeMap<usize, String>> =
            (0..self.modules.len()).map(|m| self.uses(m)).collect();
        let mut seen = BTreeSet::new();
        let mut circles = Vec::new();
        for start in 0..self.modules.len() {
            let Some(circle) = shortest_circle(&edges, start) else {
                continue;
            };
            if seen.insert(circle.iter().copied().collect::<BTreeSet<_>>()) {
                circles.push(self.describe(&edges, &circle));
            }
        }
        circles
    }

    fn describe(&self, edges: &[BTreeMap<usize, String>], circle: &[usize]) -> String {
        let next = circle.iter().cycle().skip(1);
        let step = |(&from, &to): (&usize, &usize)| {
            let (from_name, to_name) = (self.name(from), self.name(to));
            format!("{from_name} uses {to_name}::{}", edges[from][&to])
        };
        let steps: Vec<String> = circle.iter().zip(next).map(step).collect();
        steps.join(", ")
    }

    fn name(&self, module: usize) -> &str {
        match self.modules[module].name.as_str() {
            "" => "crate",
            name => name,
        }
    }

    /// The modules that `module` uses, each with one thing that it takes from there.
    fn uses(&self, module: usize) -> BTreeMap<usize, String> {
        let imports = self.modules[module].imports.iter();
        let imported = imports
            .filter(|import| !import.is_re_export)
            .map(|import| &import.path);
        imported
            .chain(&self.modules[module].paths)
            .filter_map(|path| self.resolve(module, path, 0))
            .filter(|target| target.module != module)
            .filter_map(|target| Some((target.module, target.item?)))
            .collect()
    }

    /// What `path` means in `module`; none if it leads out of the crate.
    fn resolve(&self, module: usize, path: &[String], depth: usize) -> Option<Target> {
        let (mut module, mut rest) = match path.first()?.as_str() {
            "crate" => (0, &path[1..]),
            "self" => (module, &path[1..]),
            "super" => (self.modules[module].parent, &path[1..]),
            _ => (module, path),
        };
        while rest.first().is_some_and(|name| name == "super") {
            (module, rest) = (self.modules[module].parent, &rest[1..]);
        }
        while let Some(&child) = rest
            .first()
            .and_then(|n| self.modules[module].children.get(n))
        {
            (module, rest) = (child, &rest[1..]);
        }
        let Some(name) = rest.first() else {
            return Some(Target { module, item: None });
        };
        if self.modules[module].defined.contains(name) {
            let item = Some(name.clone());
            return Some(Target { module, item });
        }
        if depth == LONGEST_CHAIN {
            return None;
        }
        let follow = |import: &Import| {
            let path = match &import.name {
                Some(imported) if imported == name => [&import.path, &rest[1..]].concat(),
                Some(_) => return None,
                None => [&import.path, rest].concat(),
            };
            let is_itself = path == rest;
            (!is_itself).then(|| self.resolve(module, &path, depth + 1))?
        };
        self.modules[module].imports.iter().find_map(follow)
    }
}

/// The shortest way from `start` along `edges` back to it.
fn shortest_circle(edges: &[BTreeMap<usize, String>], start: usize) -> Option<Vec<usize>> {
    let mut came_from = BTreeMap::new();
    let mut queue = VecDeque::from([start]);
    while let Some(module) = queue.pop_front() {
        for &next in edges[module].keys() {
            if next == start {
                let back = |module: &usize| came_from.get(module).copied();
                let mut circle: Vec<usize> = std::iter::successors(Some(module), back).collect();
                circle.reverse();
                return Some(circle);
            }
            if let Entry::Vacant(unseen) = came_from.entry(next) {
                unseen.insert(module);
                queue.push_back(next);
            }
        }
    }
    None
}

/// The file of the module whose children stand in `folder`.
fn module_file(folder: &Path) -> PathBuf {
    let file = folder.with_extension("rs");
    if file.is_file() {
        return file;
    }
    folder.join("mod.rs")
}

fn only_for_tests(attributes: &[Attribute]) -> bool {
    let is_test = |attribute: &Attribute| {
        let path = attribute.path();
        let list = || Some(attribute.meta.require_list().ok()?.tokens.to_string());
        path.is_ident("test") || path.is_ident("cfg") && list().is_some_and(|on| on == "test")
    };
    attributes.iter().any(is_test)
}

/// The names that an item defines. What a macro's call defines is found by its keywords.
fn defined_names(item: &Item) -> Vec<String> {
    let name = match item {
        Item::Const(item) => &item.ident,
        Item::Enum(item) => &item.ident,
        Item::Fn(item) => &item.sig.ident,
        Item::Macro(item) => {
            let own = item.ident.iter().map(ToString::to_string);
            return own.chain(types_in(item.mac.tokens.clone())).collect();
        }
        Item::Static(item) => &item.ident,
        Item::Struct(item) => &item.ident,
        Item::Trait(item) => &item.ident,
        Item::Type(item) => &item.ident,
        Item::Union(item) => &item.ident,
        _ => return Vec::new(),
    };
    vec![name.to_string()]
}

/// Names of the types that tokens define.
fn types_in(tokens: TokenStream) -> Vec<String> {
    let mut types = Vec::new();
    let mut follows_keyword = false;
    for token in tokens {
        match token {
            TokenTree::Ident(name) if follows_keyword => {
                types.push(name.to_string());
                follows_keyword = false;
            }
            TokenTree::Ident(name) => follows_keyword = name == "struct" || name == "enum",
            TokenTree::Group(group) => types.extend(types_in(group.stream())),
            _ => follows_keyword = false,
        }
    }
    types
}

fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Const(item) => &item.attrs,
        Item::Enum(item) => &item.attrs,
        Item::Fn(item) => &item.attrs,
        Item::Impl(item) => &item.attrs,
        Item::Macro(item) => &item.attrs,
        Item::Static(item) => &item.attrs,
        Item::Struct(item) => &item.attrs,
        Item::Trait(item) => &item.attrs,
        Item::Type(item) => &item.attrs,
        Item::Use(item) => &item.attrs,
        _ => &[],
    }
}

/// Collects what a module's code names.
struct Reader<'m>(&'m mut Module);

impl<'ast> Visit<'ast> for Reader<'_> {
    fn visit_item(&mut self, item: &'ast Item) {
        if !only_for_tests(attributes(item)) {
            visit::visit_item(self, item);
        }
    }

    fn visit_impl_item(&mut self, item: &'ast ImplItem) {
        let attributes = match item {
            ImplItem::Fn(item) => &item.attrs[..],
            _ => &[],
        };
        if !only_for_tests(attributes) {
            visit::visit_impl_item(self, item);
        }
    }

    fn visit_attribute(&mut self, _: &'ast Attribute) {}

    fn visit_item_use(&mut self, item: &'ast ItemUse) {
        let is_re_export = !matches!(item.vis, Visibility::Inherited);
        self.import(&item.tree, &mut Vec::new(), is_re_export);
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let segments = path.segments.iter();
        let path_text = segments.map(|segment| segment.ident.to_string()).collect();
        self.0.paths.insert(path_text);
        visit::visit_path(self, path);
    }

    fn visit_macro(&mut self, called: &'ast Macro) {
        self.visit_path(&called.path);
        self.tokens(called.tokens.clone());
    }
}

impl Reader<'_> {
    fn import(&mut self, tree: &UseTree, path: &mut Vec<String>, is_re_export: bool) {
        let mut add = |name: Option<String>, path: Vec<String>| {
            self.0.imports.push(Import {
                name,
                path,
                is_re_export,
            });
        };
        match tree {
            UseTree::Path(tree) => {
                path.push(tree.ident.to_string());
                self.import(&tree.tree, path, is_re_export);
                path.pop();
            }
            UseTree::Name(tree) if tree.ident == "self" => add(path.last().cloned(), path.clone()),
            UseTree::Name(tree) => {
                let name = tree.ident.to_string();
                add(Some(name.clone()), [&path[..], &[name]].concat());
            }
            UseTree::Rename(tree) => {
                let full = [&path[..], &[tree.ident.to_string()]].concat();
                add(Some(tree.rename.to_string()), full);
            }
            UseTree::Glob(_) => add(None, path.clone()),
            UseTree::Group(group) => {
                for tree in &group.items {
                    self.import(tree, path, is_re_export);
                }
            }
        }
    }

    /// Collects the paths in a macro's arguments, whatever their grammar.
    fn tokens(&mut self, tokens: TokenStream) {
        let mut path: Vec<String> = Vec::new();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Ident(name) => {
                    if colons != 2 {
                        self.0.paths.insert(std::mem::take(&mut path));
                    }
                    path.push(name.to_string());
                    colons = 0;
                }
                TokenTree::Punct(punct) if punct.as_char() == ':' => colons += 1,
                TokenTree::Group(group) => {
                    colons = 0;
                    self.tokens(group.stream());
                }
                _ => colons = 0,
            }
        }
        self.0.paths.insert(path);
    }
}

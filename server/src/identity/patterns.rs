//! Names of robots and sessions that an identity is bound to.

/// Names, with `*` for any run of characters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Patterns(pub(super) Vec<String>);

impl Patterns {
    pub(super) fn any() -> Self {
        Self(vec!["*".to_owned()])
    }

    pub(super) fn has(&self, name: &str) -> bool {
        self.0.iter().any(|pattern| matches(pattern, name))
    }
}

/// Whether `name` is what `pattern` describes; takes time in proportion to the product of their lengths at most.
fn matches(pattern: &str, name: &str) -> bool {
    let Some((start, rest)) = pattern.split_once('*') else {
        return pattern == name;
    };
    let Some(mut left) = name.strip_prefix(start) else {
        return false;
    };
    let Some((middle, end)) = rest.rsplit_once('*') else {
        return left.ends_with(rest);
    };
    for part in middle.split('*') {
        let Some(at) = left.find(part) else {
            return false;
        };
        left = &left[at + part.len()..];
    }
    left.ends_with(end)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_mean_what_they_say() {
        for (pattern, name, expected) in [
            ("lab", "lab", true),
            ("lab", "lab2", false),
            ("*", "", true),
            ("*", "anything", true),
            ("lab-*", "lab-1", true),
            ("lab-*", "my-lab-1", false),
            ("*-arm", "left-arm", true),
            ("g1*x*y", "g1-x-y", true),
            ("g1*x*y", "g1-y-x", false),
            ("a*a", "a", false),
            ("a*a", "aa", true),
            ("*b*b*", "b", false),
            ("", "", true),
            ("", "x", false),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern:?} {name:?}");
        }
    }
}

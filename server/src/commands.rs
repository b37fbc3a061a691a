//! `emp-server token` and `emp-server cert`.

use std::{
    io::{self, Write as _},
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::Context as _;
use clap::{Args, Subcommand};
use emp_server::{AccessFile, CertificateFor, NewIdentity, Role, Settings, make_certificate};

/// Name of the server's certificate file.
const SERVER: &str = "server";

#[derive(Subcommand)]
pub(crate) enum Command {
    /// Add, list and revoke those who may use the server
    #[command(subcommand)]
    Token(TokenCommand),
    /// Make a certificate for this server, or for a client, with an authority of one's own
    Cert(Cert),
}

/// What to do with the access file. A running server reads it again within seconds.
#[derive(Subcommand)]
pub(crate) enum TokenCommand {
    /// Add an identity and print its token, which is shown this once and stored nowhere
    Add(Add),
    /// List the identities
    List {
        #[command(flatten)]
        file: File,
    },
    /// Take an identity out; what it has open ends
    Revoke {
        /// Name of the identity
        name: String,
        #[command(flatten)]
        file: File,
    },
}

#[derive(Args)]
pub(crate) struct File {
    /// The access file [default: `access.file` of the settings]
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
}

#[derive(Args)]
pub(crate) struct Add {
    /// Name of the identity, which logs show
    name: String,
    /// What it may do; can be given several times
    #[arg(long = "role", value_name = "ROLE", value_enum, required = true)]
    roles: Vec<Role>,
    /// Robots that it may do that with, `*` for any run of characters [default: all]
    #[arg(long, value_name = "PATTERN")]
    robots: Vec<String>,
    /// Sessions that it may do that in, `*` for any run of characters [default: all]
    #[arg(long, value_name = "PATTERN")]
    sessions: Vec<String>,
    /// DNS name in the client certificate by which it is known, instead of a token
    #[arg(long = "certificate", value_name = "NAME")]
    certificates: Vec<String>,
    /// Days until it ends [default: never]
    #[arg(long, value_name = "N")]
    days: Option<u32>,
    #[command(flatten)]
    file: File,
}

#[derive(Args)]
pub(crate) struct Cert {
    /// Names and addresses by which clients reach the server [default: localhost 127.0.0.1 `::1`]; with --client the client's name
    names: Vec<String>,
    /// Folder of the files; its authority (ca.pem, ca-key.pem) is made when it is not there
    #[arg(long, value_name = "DIR", default_value = ".")]
    folder: PathBuf,
    /// Make a client's certificate instead, for a client with one name
    #[arg(long)]
    client: bool,
    /// Days until it ends
    #[arg(long, value_name = "N", default_value_t = 365)]
    days: u32,
}

pub(crate) fn run(command: Command, settings: &Settings) -> anyhow::Result<ExitCode> {
    match command {
        Command::Token(command) => token(command, settings)?,
        Command::Cert(command) => cert(command)?,
    }
    Ok(ExitCode::SUCCESS)
}

fn token(command: TokenCommand, settings: &Settings) -> anyhow::Result<()> {
    match command {
        TokenCommand::Add(add) => {
            let path = add.file.path(settings)?;
            let new = NewIdentity {
                name: add.name,
                roles: add.roles,
                robots: add.robots,
                sessions: add.sessions,
                certificates: add.certificates,
                days: add.days,
            };
            match AccessFile::add(path, new)? {
                Some(token) => say(&token),
                None => Ok(()),
            }
        }
        TokenCommand::List { file } => AccessFile::load(file.path(settings)?)?
            .lines()
            .try_for_each(|line| say(&line)),
        TokenCommand::Revoke { name, file } => Ok(AccessFile::revoke(file.path(settings)?, &name)?),
    }
}

impl File {
    fn path<'a>(&'a self, settings: &'a Settings) -> anyhow::Result<&'a Path> {
        let file = self.file.as_ref().or(settings.access.file.as_ref());
        Ok(file.context("which file? Give --file, or set access.file")?)
    }
}

fn cert(command: Cert) -> anyhow::Result<()> {
    let Cert {
        mut names,
        folder,
        client,
        days,
    } = command;
    let (file, purpose) = match (client, &*names) {
        (true, [name]) => (name.clone(), CertificateFor::Client),
        (true, _) => anyhow::bail!("--client takes one name"),
        (false, _) => (SERVER.to_owned(), CertificateFor::Server),
    };
    if names.is_empty() {
        names = ["localhost", "127.0.0.1", "::1"]
            .map(str::to_owned)
            .to_vec();
    }
    let files = make_certificate(&folder, &file, &names, days, purpose)?;
    for path in [files.authority, files.certificate, files.key] {
        say(&path.display().to_string())?;
    }
    Ok(())
}

fn say(line: &str) -> anyhow::Result<()> {
    writeln!(io::stdout(), "{line}").context("standard output")
}

//! `emp-server cert`: a small authority of one's own, for a first run, a laboratory, or a test.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, ensure};
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose,
};
use time::{Duration, OffsetDateTime};

use crate::identity::write_private;

const AUTHORITY: &str = "emp-server authority";
/// How long an authority's own certificate is valid.
const AUTHORITY_DAYS: i64 = 3650;
/// Clocks of other machines may be behind.
const CLOCK_SKEW: Duration = Duration::hours(1);

/// Whom a certificate is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CertificateFor {
    /// A server, under the names and addresses by which clients reach it.
    Server,
    /// A client, whose name stands in the access file.
    Client,
}

impl CertificateFor {
    fn usage(self) -> ExtendedKeyUsagePurpose {
        match self {
            Self::Server => ExtendedKeyUsagePurpose::ServerAuth,
            Self::Client => ExtendedKeyUsagePurpose::ClientAuth,
        }
    }
}

/// The files of a certificate.
#[derive(Debug, Clone)]
pub struct CertificateFiles {
    /// The certificate of the authority, for the other side to trust.
    pub authority: PathBuf,
    /// The certificate.
    pub certificate: PathBuf,
    /// Its private key, which its owner alone may read.
    pub key: PathBuf,
}

/// Makes a certificate in `folder`, signed by the authority there, which is made when there is none. The files are
/// `NAME.pem` and `NAME-key.pem`.
///
/// # Errors
/// When a file cannot be written, is there already, or a name is none.
pub fn make_certificate(
    folder: &Path,
    file_name: &str,
    names: &[String],
    days: u32,
    purpose: CertificateFor,
) -> anyhow::Result<CertificateFiles> {
    fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let file = |name: &str| folder.join(name);
    let files = CertificateFiles {
        authority: file("ca.pem"),
        certificate: file(&format!("{file_name}.pem")),
        key: file(&format!("{file_name}-key.pem")),
    };
    for path in [&files.certificate, &files.key] {
        ensure!(!path.exists(), "{} is there already", path.display());
    }
    let authority = authority(&files.authority, &file("ca-key.pem"))?;
    let mut params = CertificateParams::new(names).context("the names")?;
    params.distinguished_name = common_name(names.first().map_or(file_name, String::as_str));
    params.extended_key_usages = vec![purpose.usage()];
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.use_authority_key_identifier_extension = true;
    valid_for(&mut params, i64::from(days));
    let key = KeyPair::generate()?;
    let certificate = params.signed_by(&key, &authority)?;
    write(&files.certificate, &certificate.pem())?;
    write(&files.key, &key.serialize_pem())?;
    Ok(files)
}

/// The authority of a folder. Its certificate is made from its key and a fixed name, so that the key alone brings it back.
fn authority(certificate: &Path, key_file: &Path) -> anyhow::Result<Issuer<'static, KeyPair>> {
    let mut params = CertificateParams::default();
    params.distinguished_name = common_name(AUTHORITY);
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    valid_for(&mut params, AUTHORITY_DAYS);
    let key = if key_file.exists() {
        let text = fs::read_to_string(key_file).with_context(|| key_file.display().to_string())?;
        KeyPair::from_pem(&text).with_context(|| key_file.display().to_string())?
    } else {
        let key = KeyPair::generate()?;
        write(key_file, &key.serialize_pem())?;
        key
    };
    if !certificate.exists() {
        write(certificate, &params.self_signed(&key)?.pem())?;
    }
    Ok(Issuer::new(params, key))
}

fn common_name(name: &str) -> DistinguishedName {
    let mut names = DistinguishedName::new();
    names.push(DnType::CommonName, name);
    names
}

fn valid_for(params: &mut CertificateParams, days: i64) {
    let now = OffsetDateTime::now_utc();
    params.not_before = now - CLOCK_SKEW;
    params.not_after = now + Duration::days(days);
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    write_private(path, text.as_bytes()).with_context(|| path.display().to_string())
}

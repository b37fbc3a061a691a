//! Changes of single settings from the command line.

use anyhow::{Context as _, Result, bail};
use serde::{Serialize, de::DeserializeOwned};

/// The settings with one changed: `key` is its path with dots, as in `hindsight.weight`; `value` is JSON, or a bare word.
///
/// # Errors
/// When there is no such setting, or it cannot have that value.
pub fn setting<T: Serialize + DeserializeOwned>(settings: &T, key: &str, value: &str) -> Result<T> {
    let mut settings = serde_json::to_value(settings)?;
    let place = key
        .split('.')
        .try_fold(&mut settings, |place, name| place.get_mut(name));
    let Some(place) = place else {
        bail!("no setting `{key}`; --print-settings shows all");
    };
    *place =
        serde_json::from_str(value).unwrap_or_else(|_| serde_json::Value::String(value.to_owned()));
    serde_json::from_value(settings).with_context(|| format!("setting `{key}` cannot be {value}"))
}

/// Splits `KEY=VALUE`.
///
/// # Errors
/// When there is no `=`.
pub fn pair(change: &str) -> Result<(&str, &str)> {
    change
        .split_once('=')
        .with_context(|| format!("--set {change}: expected KEY=VALUE"))
}

//! Compares output with golden files.

use std::path::Path;

/// Compares `found` with the golden file of this name; with `BLASTEMA_BLESS` set, replaces the
/// file.
pub(crate) fn check(name: &str, found: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden").join(name);
    if std::env::var_os("BLASTEMA_BLESS").is_some() {
        std::fs::write(&path, found).expect("the golden folder can be written");
    }
    let wanted = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(wanted == found, "{} differs; found:\n{found}", path.display());
}

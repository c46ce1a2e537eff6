//! How files of keys are written.

use blastema::keys::folder_of;
use std::fs::{self, File, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use tempfile::NamedTempFile;

/// The mode of a file that holds a secret.
pub(super) const SECRET: u32 = 0o600;
/// The mode of a file that all users may read.
pub(super) const PUBLIC: u32 = 0o644;
/// Refuses to overwrite.
pub(super) fn check_absent(path: &Path) -> Result<(), String> {
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(format!("{} cannot be written: {error}", path.display())),
        Ok(_) => Err(format!(
            "{0} is there already: move {0} away, or choose another folder",
            path.display()
        )),
    }
}

/// Whether a file that is there is kept or replaced.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Existing {
    Keep,
    Replace,
}

/// Writes a file under another name, waits until the disk has it, and renames it.
pub(super) fn write(path: &Path, text: &str, mode: u32, existing: Existing) -> Result<(), String> {
    let written = || -> io::Result<()> {
        let folder = folder_of(path);
        let mut file = NamedTempFile::new_in(folder)?;
        file.as_file().set_permissions(Permissions::from_mode(mode))?;
        file.write_all(text.as_bytes())?;
        file.as_file().sync_all()?;
        match existing {
            Existing::Keep => file.persist_noclobber(path)?,
            Existing::Replace => file.persist(path)?,
        };
        File::open(folder)?.sync_all()
    };
    written().map_err(|error| format!("{} cannot be written: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::MetadataExt;

    #[test]
    fn a_file_that_is_there_is_replaced_only_on_purpose_and_nothing_else_is_left() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a");
        write(&path, "one", PUBLIC, Existing::Keep).expect("it is not there");

        assert!(write(&path, "two", PUBLIC, Existing::Keep).is_err());
        assert!(check_absent(&path).expect_err("it is there").contains("move"));
        assert_eq!(fs::read_to_string(&path).unwrap(), "one");
        write(&path, "two", PUBLIC, Existing::Replace).expect("it may be replaced");

        assert_eq!(fs::read_to_string(&path).unwrap(), "two");
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, PUBLIC);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}

//! How files of keys are written.

use blastema::keys::folder_of;
use std::fs::{self, File, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use tempfile::NamedTempFile;

/// The mode of a file that holds a secret.
pub(super) const SECRET: u32 = 0o600;
/// The mode of a file that everybody may read.
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

    #[test]
    fn a_secret_that_others_can_read_or_replace_is_refused_with_the_command_that_mends_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("base.key");
        write(&path, "text", SECRET, Existing::Keep).expect("it can be written");
        let with = |file: u32, of_folder: u32| {
            fs::set_permissions(&path, Permissions::from_mode(file)).expect("it is ours");
            fs::set_permissions(folder.path(), Permissions::from_mode(of_folder))
                .expect("so is it");
            read_secret(&path).map(|text| text.len())
        };

        assert_eq!(with(0o600, 0o700), Ok(4));
        assert_eq!(with(0o400, 0o755), Ok(4));
        assert_eq!(with(0o600, 0o1777), Ok(4), "files in /tmp are their owner's");
        for mode in [0o644, 0o640, 0o604, 0o620] {
            let refused = with(mode, 0o700).expect_err("others can read or write it");
            let cure = format!("(mode {mode:04o}): chmod 600 {}", path.display());
            assert!(refused.ends_with(&cure), "{refused}");
        }
        for mode in [0o777, 0o770, 0o702] {
            let refused = with(0o600, mode).expect_err("others can write there");
            let cure = format!("(mode {mode:04o}): chmod go-w {}", folder.path().display());
            assert!(refused.ends_with(&cure), "{refused}");
        }
    }

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

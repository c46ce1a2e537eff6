//! Files of keys: which ones are refused for their permissions.

use rustix::fs::OFlags;
use rustix::process::geteuid;
use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;
use zeroize::Zeroizing;

/// No file of keys is longer.
const MOST_BYTES: u64 = 128 * 1024;
/// In a folder with this bit, a file is renamed and removed by its owner alone.
const STICKY: u32 = 0o1000;

/// Reads a file that holds a secret, if no other user can read or replace it.
///
/// # Errors
/// What is wrong with the file or its folder, and the command that mends it. No error repeats a
/// word of the file.
pub fn read_secret(path: &Path) -> Result<Zeroizing<String>, String> {
    let (mut file, metadata) = open(path, cure_of_secret)?;
    check_secret(path, &metadata)?;
    check_folder(path, folder_of(path))?;
    // The folder of the file itself, where a symbolic link stands for it.
    let real = fs::canonicalize(path).map_err(|error| unreadable(path, &error))?;
    check_folder(path, folder_of(&real))?;
    read(path, &mut file, &metadata)
}

/// Reads a file that holds no secret, such as a roster.
///
/// # Errors
/// Why the file cannot be read.
pub fn read_public(path: &Path) -> Result<Zeroizing<String>, String> {
    let (mut file, metadata) = open(path, |_| String::new())?;
    read(path, &mut file, &metadata)
}

/// Reads the roster beside a key, if no other user can change or replace it.
///
/// # Errors
/// What is wrong with the file or its folder, and the command that mends it.
pub(crate) fn read_roster(path: &Path) -> Result<Zeroizing<String>, String> {
    let (mut file, metadata) = open(path, |_| String::new())?;
    let mode = metadata.mode() & 0o7777;
    if mode & 0o022 != 0 {
        let path = path.display();
        return Err(format!(
            "{path} can be changed by others (mode {mode:04o}): chmod go-w {path}"
        ));
    }
    check_folder(path, folder_of(path))?;
    read(path, &mut file, &metadata)
}

fn open(path: &Path, cure: fn(&io::Error) -> String) -> Result<(File, Metadata), String> {
    let failed = |error: io::Error| unreadable(path, &error) + &cure(&error);
    // A FIFO would keep the thread until another process writes to it.
    let flags = OFlags::NONBLOCK.bits().cast_signed();
    let file = OpenOptions::new().read(true).custom_flags(flags).open(path).map_err(failed)?;
    let metadata = file.metadata().map_err(failed)?;
    if !metadata.is_file() {
        return Err(format!("{} is no file: name a file of keys", path.display()));
    }
    if metadata.len() > MOST_BYTES {
        return Err(format!(
            "{} has more than {MOST_BYTES} bytes: it is no file of keys",
            path.display()
        ));
    }
    Ok((file, metadata))
}

fn read(path: &Path, file: &mut File, metadata: &Metadata) -> Result<Zeroizing<String>, String> {
    // With room for all of it, so that no copy is left behind in a buffer that grew.
    let mut text = Zeroizing::new(String::with_capacity(metadata.len() as usize + 1));
    let most = metadata.len();
    let read = file.take(most).read_to_string(&mut text);
    read.map_err(|error| match error.kind() {
        io::ErrorKind::InvalidData => {
            format!("{} is no text, as files of keys are: copy the file again", path.display())
        }
        _ => unreadable(path, &error),
    })?;
    Ok(text)
}

fn unreadable(path: &Path, error: &io::Error) -> String {
    format!("{} cannot be read: {error}", path.display())
}

fn cure_of_secret(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::NotFound => ": copy the file there, or name the file that is meant".into(),
        io::ErrorKind::PermissionDenied => {
            let own = geteuid().as_raw();
            format!(": it must belong to the user that runs this, uid {own}, with mode 600")
        }
        _ => String::new(),
    }
}

/// Refuses a secret that other users can read, or that is theirs.
fn check_secret(path: &Path, file: &Metadata) -> Result<(), String> {
    let (path, mode) = (path.display(), file.mode() & 0o7777);
    if mode & 0o077 != 0 {
        return Err(format!("{path} can be read by others (mode {mode:04o}): chmod 600 {path}"));
    }
    let own = geteuid().as_raw();
    match file.uid() {
        owner if owner == own || own == 0 => Ok(()),
        owner => Err(format!(
            "{path} belongs to uid {owner}, and this is uid {own}: copy it as this user"
        )),
    }
}

/// Refuses a folder in which other users can replace files.
fn check_folder(path: &Path, folder: &Path) -> Result<(), String> {
    let failed = |error| format!("{} cannot be looked at: {error}", folder.display());
    let mode = fs::metadata(folder).map_err(failed)?.mode() & 0o7777;
    if mode & 0o022 == 0 || mode & STICKY != 0 {
        return Ok(());
    }
    Err(format!(
        "{} can be replaced by others, who can write to its folder (mode {mode:04o}): chmod go-w {}",
        path.display(),
        folder.display()
    ))
}

/// The folder of a file.
pub fn folder_of(path: &Path) -> &Path {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    parent.unwrap_or(Path::new("."))
}

/// By which it is seen that a file was replaced or written to: its number, size and time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FileStamp {
    number: u64,
    length: u64,
    modified: (i64, i64),
}

impl FileStamp {
    /// Of the file there, if there is one.
    pub(crate) fn of(path: &Path) -> Option<Self> {
        let file = fs::metadata(path).ok()?;
        let modified = (file.mtime(), file.mtime_nsec());
        Some(FileStamp { number: file.ino(), length: file.len(), modified })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{CWD, FileType, Mode};
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_secret_that_others_can_read_or_replace_is_refused_with_the_command_that_mends_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("base.key");
        fs::write(&path, "text").expect("it can be written");
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
    fn a_roster_that_others_can_change_is_refused_and_may_be_read_by_all() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ranger.roster");
        fs::write(&path, "text").expect("it can be written");
        let with = |mode: u32| {
            fs::set_permissions(&path, Permissions::from_mode(mode)).expect("it is ours");
            read_roster(&path).map(|text| text.len())
        };

        assert_eq!((with(0o644), with(0o400)), (Ok(4), Ok(4)));
        for mode in [0o664, 0o646] {
            let refused = with(mode).expect_err("others can write it");
            let cure = format!("(mode {mode:04o}): chmod go-w {}", path.display());
            assert!(refused.ends_with(&cure), "{refused}");
        }
    }

    #[test]
    fn a_symbolic_link_to_a_folder_of_others_is_refused_as_that_folder_is() {
        let (own, others) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let (link, file) = (own.path().join("base.key"), others.path().join("base.key"));
        fs::write(&file, "text").expect("it can be written");
        fs::set_permissions(&file, Permissions::from_mode(0o600)).expect("it is ours");
        std::os::unix::fs::symlink(&file, &link).expect("it is not there");
        assert_eq!(read_secret(&link).map(|text| text.len()), Ok(4));

        fs::set_permissions(others.path(), Permissions::from_mode(0o777)).expect("it is ours");

        let refused = read_secret(&link).expect_err("others can write there");
        assert!(refused.contains("chmod go-w") && refused.contains("mode 0777"), "{refused}");
    }

    #[test]
    fn what_is_no_file_of_keys_is_refused_at_once_with_what_to_do() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let (fifo, bytes) = (at("fifo"), at("bytes"));
        let mode = Mode::from_raw_mode(0o600);
        rustix::fs::mknodat(CWD, &fifo, FileType::Fifo, mode, 0).expect("it is not there");
        fs::write(&bytes, [0xff, 0]).expect("it can be written");
        fs::set_permissions(&bytes, Permissions::from_mode(0o600)).expect("it is ours");
        let refused = |path: &Path, cure: &str| {
            for read in [read_secret, read_public] {
                let text = read(path).expect_err(cure);
                assert!(text.ends_with(cure), "{text}");
            }
        };

        refused(&fifo, "is no file: name a file of keys");
        refused(folder.path(), "is no file: name a file of keys");
        refused(&bytes, "is no text, as files of keys are: copy the file again");
        let missing = read_secret(&at("none")).expect_err("there is none");
        assert!(
            missing.ends_with("copy the file there, or name the file that is meant"),
            "{missing}"
        );
    }
}

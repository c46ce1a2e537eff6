//! A file that is replaced as a whole.

use crate::platform::file_lock::beside;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;
use std::process;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;

/// Makes names different that threads of one process write at a time.
static COUNT: AtomicU64 = AtomicU64::new(0);

/// Writes a file beside the old one, synchronises it to the disk, and renames it over the old one:
/// whatever ends the process, or the power, leaves the old file or the new one.
pub(crate) fn replace_file(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // Processes may share the folder.
    let number = COUNT.fetch_add(1, Relaxed);
    let new = beside(path, &format!("{}-{number}.new", process::id()));
    let written = || {
        let mut file = File::create_new(&new)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&new, path)
    };
    written().inspect_err(|_| drop(fs::remove_file(&new)))?;
    // That it has its name now is the folder's content.
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread;

    #[test]
    fn several_writers_at_once_leave_a_whole_file_and_no_other() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ranger.roster");
        let texts = [1u8, 2, 3, 4].map(|letter| vec![letter; 1000]);
        let write = |text: &[u8]| (0..20).try_for_each(|_| replace_file(&path, text));

        thread::scope(|scope| {
            let writers = texts.each_ref().map(|text| scope.spawn(|| write(text)));
            for writer in writers {
                writer.join().expect("no panic").expect("each can write");
            }
        });

        assert!(texts.contains(&fs::read(&path).expect("it is there")));
        assert_eq!(fs::read_dir(folder.path()).expect("it is ours").count(), 1);
    }

    #[test]
    fn what_cannot_be_renamed_leaves_no_file_behind() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ranger.roster");
        fs::create_dir(&path).expect("it is not there");

        assert!(replace_file(&path, b"text").is_err(), "a folder is there");

        assert_eq!(fs::read_dir(folder.path()).expect("it is ours").count(), 1);
    }
}

//! A program that every user can run.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Makes `program` reachable for every user in `folder`, which must be open to them, and returns
/// its new path.
///
/// It is a hard link, which needs no disk; a copy where `folder` is on another file system.
///
/// # Panics
///
/// When neither can be made.
pub fn program_in(folder: &Path, program: &Path) -> PathBuf {
    let path = folder.join("program");
    if fs::hard_link(program, &path).is_err() {
        // By another process: a file that this one has open for writing could be inherited by what
        // another test starts just then, and cannot be executed before that has closed it.
        let copied = Command::new("cp").arg(program).arg(&path).status();
        assert!(copied.expect("there is cp").success(), "no copy of {}", program.display());
    }
    path
}

//! The C library, compiled by `cc`, as a child process at the other end of a socket pair.

use crate::bench::{Bench, Medium, PORTS};
use blastema_lite::ResetCause;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Longer than any answer takes on a computer under load.
const BOUND: Duration = Duration::from_secs(60);

/// The C library with the firmware of the suite.
pub(crate) struct CSide {
    child: Child,
    line: UnixStream,
}

impl CSide {
    pub(crate) fn new(medium: Medium) -> CSide {
        CSide::with_flags(medium, &[])
    }

    /// Compiled with these flags besides.
    pub(crate) fn with_flags(medium: Medium, flags: &[&str]) -> CSide {
        let program = program(medium, flags);
        let (line, end) = UnixStream::pair().expect("a socket pair");
        line.set_read_timeout(Some(BOUND)).expect("a timeout");
        let input = end.try_clone().expect("the end again");
        let child = Command::new(program)
            .stdin(Stdio::from(OwnedFd::from(input)))
            .stdout(Stdio::from(OwnedFd::from(end)))
            .spawn()
            .expect("the firmware starts");
        let mut side = CSide { child, line };
        side.reset(Duration::ZERO, ResetCause::PowerOn);
        side
    }

    fn request(&mut self, operation: u8, now: Duration, bytes: &[u8]) -> Vec<Vec<u8>> {
        let mut request = vec![operation];
        request.extend((now.as_millis() as u32).to_le_bytes());
        request.extend(u16::try_from(bytes.len()).expect("a short request").to_le_bytes());
        request.extend(bytes);
        self.line.write_all(&request).expect("the firmware reads");
        let (mut received, mut buffer) = (Vec::new(), [0; 4096]);
        loop {
            let count = self.line.read(&mut buffer).expect("the firmware answers in time");
            assert!(count > 0, "the firmware has ended: {:?}", self.child.wait());
            received.extend(&buffer[..count]);
            if let Some(pieces) = pieces(&received) {
                return pieces;
            }
        }
    }
}

/// The pieces of a whole answer.
fn pieces(mut bytes: &[u8]) -> Option<Vec<Vec<u8>>> {
    let mut pieces = Vec::new();
    loop {
        let (&length, rest) = bytes.split_first()?;
        if length == 0 {
            assert!(rest.is_empty(), "one answer to one request");
            return Some(pieces);
        }
        let (piece, rest) = rest.split_at_checked(length.into())?;
        pieces.push(piece.to_vec());
        bytes = rest;
    }
}

impl Bench for CSide {
    fn run(&mut self, now: Duration, bytes: &[u8]) -> Vec<Vec<u8>> {
        self.request(0, now, bytes)
    }

    fn reset(&mut self, now: Duration, cause: ResetCause) {
        self.request(1, now, &[cause as u8]);
    }
}

impl Drop for CSide {
    fn drop(&mut self) {
        // It ends at the end of its input; a test that failed may have left it hanging.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub(crate) fn is_long() -> bool {
    std::env::var_os("BLASTEMA_LONG").is_some_and(|value| value == "1")
}

/// The programs that this run has compiled.
static PROGRAMS: Mutex<BTreeMap<String, PathBuf>> = Mutex::new(BTreeMap::new());

fn program(medium: Medium, flags: &[&str]) -> PathBuf {
    // Another test that failed to compile has said why.
    let mut programs: MutexGuard<'_, _> = PROGRAMS.lock().unwrap_or_else(PoisonError::into_inner);
    let key = format!("{medium:?}{}{}", flags.concat(), if is_long() { "-sanitized" } else { "" });
    let compiled = || {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
        let (program, fresh) = (folder.join(&key), folder.join(std::process::id().to_string()));
        compile(&fresh, medium, flags);
        // Another run of the tests may execute the program of the same name.
        std::fs::rename(fresh, &program).expect("a program in the tests' folder");
        program
    };
    programs.entry(key.clone()).or_insert_with(compiled).clone()
}

const SANITIZERS: &str = "-fsanitize=address,undefined";

fn compile(program: &Path, medium: Medium, flags: &[&str]) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let compiler = |sanitized: bool| {
        let mut command = Command::new("cc");
        command.args(["-std=c99", "-D_POSIX_C_SOURCE=200809L", "-O2", "-g"]);
        command.args(["-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]);
        command.args(["-DBL_OBJECTS=2u", "-DBL_MAX_DATA=240u"]);
        command.arg(format!("-DBL_PORTS={}u", PORTS.len()));
        match medium {
            Medium::Serial => {}
            Medium::Multidrop => drop(command.arg("-DBL_ADDRESS=7")),
            Medium::Datagram => drop(command.arg("-DBL_DATAGRAM")),
        }
        if sanitized {
            command.args([SANITIZERS, "-fno-sanitize-recover=all"]);
        }
        command.args(flags).arg("-I").arg(root.join("c")).arg("-o").arg(program);
        command.args([root.join("c/blastema_lite.c"), root.join("tests/virtual/firmware.c")]);
        command.output().expect("the tests need a C compiler, `cc`")
    };
    let mut output = compiler(is_long());
    if is_long() && !output.status.success() {
        println!("without sanitizers: {}", String::from_utf8_lossy(&output.stderr));
        output = compiler(false);
    }
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

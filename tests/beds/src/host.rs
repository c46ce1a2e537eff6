//! A process of a node, as the one who started it sees it.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// The lines that a process has printed so far.
#[derive(Default)]
struct Lines {
    lines: Mutex<(Vec<String>, bool)>,
    /// When each of them came.
    times: Mutex<Vec<Instant>>,
    more: Condvar,
}

impl Lines {
    fn lock(&self) -> MutexGuard<'_, (Vec<String>, bool)> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A node in a process of its own. It is killed when this is dropped.
pub(crate) struct Host {
    pub(crate) name: String,
    child: Child,
    stdin: Option<ChildStdin>,
    lines: Arc<Lines>,
    /// What was awaited so far lies before this line.
    read: usize,
}

impl Host {
    /// Starts this program with these arguments in a namespace.
    pub(crate) fn start(name: &str, namespace: &str, arguments: &[String]) -> Result<Host, String> {
        let program = std::env::current_exe().map_err(|error| error.to_string())?;
        let mut child = Command::new("ip")
            .args(["netns", "exec", namespace])
            .arg(program)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| format!("ip netns exec: {error}"))?;
        let (stdin, stdout) = (child.stdin.take(), child.stdout.take());
        let lines = Arc::new(Lines::default());
        let kept = lines.clone();
        std::thread::spawn(move || {
            for line in stdout.into_iter().flat_map(|out| BufReader::new(out).lines()) {
                let Ok(line) = line else { break };
                kept.times.lock().unwrap_or_else(PoisonError::into_inner).push(Instant::now());
                kept.lock().0.push(line);
                kept.more.notify_all();
            }
            kept.lock().1 = true;
            kept.more.notify_all();
        });
        Ok(Host { name: name.into(), child, stdin, lines, read: 0 })
    }

    /// Says something to it.
    pub(crate) fn order(&mut self, command: &str) -> Result<(), String> {
        let stdin = self.stdin.as_mut().ok_or("its standard input is closed")?;
        writeln!(stdin, "{command}").map_err(|error| format!("{}: {error}", self.name))
    }

    /// What it prints from now on is awaited next; what it has printed is past.
    pub(crate) fn forget(&mut self) {
        self.read = self.lines.lock().0.len();
    }

    /// Waits for this line, after those awaited before; answers the lines in between.
    pub(crate) fn expect(&mut self, wanted: &str, within: Duration) -> Result<Vec<String>, String> {
        let end = Instant::now() + within;
        let mut lines = self.lines.lock();
        loop {
            if let Some(at) = lines.0[self.read..].iter().position(|line| line == wanted) {
                let between = lines.0[self.read..self.read + at].to_vec();
                self.read += at + 1;
                return Ok(between);
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() || lines.1 {
                let why = if lines.1 { "ended" } else { "did not say so in time" };
                let last = lines.0.iter().rev().take(12).rev().cloned().collect::<Vec<_>>();
                let last = last.join("\n    ");
                return Err(format!(
                    "{} {why}: {wanted:?}; its last words:\n    {last}",
                    self.name
                ));
            }
            let waited = self.lines.more.wait_timeout(lines, left);
            lines = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Waits for this line wherever it stands after those awaited before, and goes no further.
    pub(crate) fn expect_also(&mut self, wanted: &str, within: Duration) -> Result<(), String> {
        let read = self.read;
        let found = self.expect(wanted, within);
        self.read = read;
        found.map(|_| ())
    }

    /// The first line that begins so, wherever it stands.
    pub(crate) fn has_said(&self, beginning: &str) -> Option<String> {
        self.lines.lock().0.iter().find(|line| line.starts_with(beginning)).cloned()
    }

    /// Its latest lines, for display.
    pub(crate) fn last_words(&self, count: usize) -> String {
        let times = self.lines.times.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let lines = self.lines.lock();
        let last = lines.0.len().saturating_sub(count);
        let told = lines.0.iter().zip(&times).skip(last);
        told.map(|(line, at)| {
            let ago = at.elapsed().as_millis();
            format!("    {ago:>6} ms ago, {}: {line}\n", self.name)
        })
        .collect()
    }

    /// Ends it in order, or by force where that takes too long.
    pub(crate) fn end(mut self, within: Duration) -> Result<(), String> {
        drop(self.stdin.take());
        let end = Instant::now() + within;
        while Instant::now() < end {
            match self.child.try_wait() {
                Ok(Some(status)) if status.success() => return Ok(()),
                Ok(Some(status)) => return Err(format!("{} ended with {status}", self.name)),
                _ => std::thread::sleep(Duration::from_millis(10)),
            }
        }
        Err(format!("{} does not end", self.name))
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

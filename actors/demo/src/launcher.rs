//! Starts the processes of the modules.

use super::control::ControlListener;
use super::robot::Module;
use std::collections::VecDeque;
use std::io;
use std::path::PathBuf;
use std::process::Stdio;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, BufReader};
use tokio::process::{Child, Command};
use tokio::sync::mpsc::Sender;
use tokio::sync::oneshot;

/// Lines of a module's standard error that are kept, to be shown if it ends by itself.
const LAST_WORDS: usize = 12;
/// The longest line of them that is kept, in bytes.
const LINE_LIMIT: u64 = 400;

/// A module's process while it runs.
#[derive(Debug)]
pub(crate) struct Process {
    /// Its number in the operating system.
    pub(crate) id: i32,
    kill: Option<oneshot::Sender<()>>,
}

/// A module's process has ended.
#[derive(Debug)]
pub(crate) struct ModuleEnded {
    /// Which module.
    pub(crate) module: Module,
    /// Which process.
    pub(crate) id: i32,
    /// Its status, and the last that it wrote to standard error.
    pub(crate) how: String,
}

impl Process {
    /// Starts a module with this program's own executable.
    ///
    /// It is in a process group of its own, so that Ctrl-C in the terminal reaches the director
    /// alone, which then ends all in order. It ends with this process, however that ends: the
    /// module asks the kernel for it, and its control channel closes.
    ///
    /// # Errors
    /// The operating system starts no more processes.
    pub(crate) fn launch(
        module: Module,
        listener: &ControlListener,
        ends: Sender<ModuleEnded>,
    ) -> io::Result<Process> {
        let mut child = Command::new(executable())
            .arg0("blastema")
            .arg("module")
            .args(["--name", module.name()])
            .arg("--control")
            .arg(listener.path())
            .arg("--keys")
            .arg(listener.key_of(module))
            .args(["--parent", &std::process::id().to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .process_group(0)
            .kill_on_drop(true)
            .spawn()?;
        let id = child.id().and_then(|id| i32::try_from(id).ok());
        let id = id.ok_or_else(|| io::Error::other("a new process has no number"))?;
        let (kill, killed) = oneshot::channel();
        tokio::spawn(async move {
            let how = follow(&mut child, killed).await;
            // The director may have ended.
            let _ = ends.send(ModuleEnded { module, id, how }).await;
        });
        Ok(Process { id, kill: Some(kill) })
    }

    /// Kills it with signal 9. Its end is reported like any other.
    pub(crate) fn kill(&mut self) {
        // A process that has just ended is reported as well.
        let _ = self.kill.take().map(|kill| kill.send(()));
    }

    /// Returns whether its kill was ordered.
    pub(crate) fn is_killed(&self) -> bool {
        self.kill.is_none()
    }
}

/// This program. The link stays right even if the file was replaced since this process started, but
/// gives the process no name.
fn executable() -> PathBuf {
    let by_name = std::env::current_exe().ok().filter(|path| path.exists());
    by_name.unwrap_or_else(|| "/proc/self/exe".into())
}

async fn follow(child: &mut Child, killed: oneshot::Receiver<()>) -> String {
    let words = tokio::spawn(last_words(child.stderr.take()));
    let status = tokio::select! {
        status = child.wait() => status,
        Ok(()) = killed => {
            // It may have ended in the same instant.
            let _ = child.start_kill();
            child.wait().await
        }
    };
    let status = match status {
        Ok(status) => status.to_string(),
        Err(error) => error.to_string(),
    };
    match words.await.unwrap_or_default() {
        words if words.is_empty() => status,
        words => format!("{status}; its last words: {words}"),
    }
}

async fn last_words(stderr: Option<impl AsyncReadExt + Unpin>) -> String {
    let Some(stderr) = stderr else { return String::new() };
    let mut reader = BufReader::new(stderr);
    let mut lines = VecDeque::new();
    let mut line = Vec::new();
    while let Ok(1..) = (&mut reader).take(LINE_LIMIT).read_until(b'\n', &mut line).await {
        if lines.len() == LAST_WORDS {
            lines.pop_front();
        }
        lines.push_back(String::from_utf8_lossy(&line).trim().to_owned());
        line.clear();
    }
    Vec::from(lines).join(" | ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_last_words_are_kept_and_no_more() {
        let many: String = (0..50).map(|line| format!("line {line}\n")).collect();
        let long = "x".repeat(10_000);

        let words = last_words(Some(many.as_bytes())).await;
        let cut = last_words(Some(long.as_bytes())).await;

        assert!(words.starts_with("line 38 | ") && words.ends_with("line 49"), "{words}");
        assert!(cut.len() < LAST_WORDS * 404, "{}", cut.len());
        assert_eq!(last_words(None::<&[u8]>).await, "");
    }
}

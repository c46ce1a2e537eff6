//! Reads the snapshot of a node from its inspection socket, and explains a failure.

use rustix::io::Errno;
use serde_json::Value;
use std::os::unix::fs::FileTypeExt;
use std::path::Path;
use std::time::Duration;
use std::{fs, io};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::UnixStream;
use tokio::time::{sleep, timeout};

/// The longest snapshot that is read: that of ten thousand components takes a third of it.
const LONGEST: u64 = 16 << 20;
/// The longest path of a Unix-domain socket on Linux, in bytes, without the closing zero.
const LONGEST_PATH: usize = 107;
/// The pause after which a socket with a full listen backlog is tried again.
const PAUSE: Duration = Duration::from_millis(10);

/// Says that the process at this path is not a node.
pub(crate) fn no_node(path: &Path, reason: &str) -> String {
    format!(
        "this is no inspection socket of a node: {} shows {reason}; give the path that \
         NodeBuilder::inspection_socket was given",
        path.display()
    )
}

/// The snapshot of a node: as received, and as a document.
pub(crate) struct ReceivedSnapshot {
    pub(crate) text: String,
    pub(crate) snapshot: Value,
}

/// The process at the other end of the socket.
#[derive(Clone, Copy)]
enum NodeProcess {
    /// The connection has not been accepted.
    Unreached,
    /// A process, by its id; a process of another PID namespace has none.
    There { process: Option<i32> },
}

/// Looks once.
///
/// # Errors
/// The cause, and what to do.
pub(crate) async fn look(path: &Path, within: Duration) -> Result<ReceivedSnapshot, String> {
    read(ask(path, "", within).await?).map_err(|reason| no_node(path, &reason))
}

/// Sends a line, or nothing, and returns what the node sends.
///
/// # Errors
/// The cause, and what to do.
pub(crate) async fn ask(path: &Path, line: &str, within: Duration) -> Result<Vec<u8>, String> {
    let mut peer = NodeProcess::Unreached;
    let asked = timeout(within, async {
        let mut socket = connect(path).await?;
        let number = socket.peer_cred().ok().and_then(|peer| peer.pid());
        peer = NodeProcess::There { process: number.filter(|number| *number > 0) };
        // A process that shows something else may have closed the connection already.
        let _ = socket.write_all(line.as_bytes()).await;
        let _ = socket.shutdown().await;
        let mut bytes = Vec::new();
        socket.take(LONGEST).read_to_end(&mut bytes).await?;
        Ok::<_, io::Error>(bytes)
    });
    match asked.await {
        Ok(Ok(bytes)) => Ok(bytes),
        Ok(Err(error)) => {
            Err(format!("no node answers at {}: {}", path.display(), explain(path, &error)))
        }
        Err(_) => Err(format!(
            "the node at {} did not answer within {} s: {}",
            path.display(),
            within.as_secs_f64(),
            silence_of(peer)
        )),
    }
}

async fn connect(path: &Path) -> io::Result<UnixStream> {
    loop {
        match UnixStream::connect(path).await {
            // The listen backlog is full.
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => sleep(PAUSE).await,
            connected => return connected,
        }
    }
}

fn read(bytes: Vec<u8>) -> Result<ReceivedSnapshot, String> {
    if bytes.is_empty() {
        return Err("nothing".to_owned());
    }
    if bytes.len() as u64 >= LONGEST {
        return Err(format!("more than {LONGEST} bytes"));
    }
    let text = String::from_utf8(bytes).map_err(|_| "what is no text".to_owned())?;
    let snapshot: Value = serde_json::from_str(&text)
        .map_err(|error| format!("what is no JSON document ({error})"))?;
    match lacking(&snapshot) {
        None => Ok(ReceivedSnapshot { text, snapshot }),
        Some(lacking) => Err(format!("a document without {lacking:?}")),
    }
}

/// Returns a required key that the snapshot lacks.
fn lacking(snapshot: &Value) -> Option<&'static str> {
    let known = |part: &Value| part.is_array() || part.is_null();
    let has = |key: &str, is: fn(&Value) -> bool| snapshot.get(key).is_some_and(is);
    let texts = ["node", "state"].into_iter().find(|key| !has(key, Value::is_string));
    let number = (!has("incarnation", Value::is_u64)).then_some("incarnation");
    let parts = ["table", "threads", "links", "faults"].into_iter();
    texts.or(number).or(parts.into_iter().find(|key| !snapshot.get(*key).is_some_and(known)))
}

/// Describes why no connection is possible.
fn explain(path: &Path, error: &io::Error) -> String {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    match error.kind() {
        _ if path.as_os_str().len() > LONGEST_PATH => format!(
            "a socket's path has at most {LONGEST_PATH} bytes, and this one {}: name it from within \
             its folder, or by a shorter link",
            path.as_os_str().len()
        ),
        _ if path.is_dir() => "it is a folder: name the inspection socket in it".to_owned(),
        _ if fs::metadata(path).is_ok_and(|found| !found.file_type().is_socket()) => {
            "it is a file and no socket: give the path that NodeBuilder::inspection_socket was given"
                .to_owned()
        }
        io::ErrorKind::NotFound if folder.is_some_and(|folder| !folder.exists()) => {
            format!("there is no folder {}: correct the path", folder.unwrap_or(path).display())
        }
        io::ErrorKind::NotFound => {
            "nothing is there: start the node, or give it this path by NodeBuilder::inspection_socket"
                .to_owned()
        }
        io::ErrorKind::ConnectionRefused => {
            "the node that was shown there has died, or does not listen yet: restart it".to_owned()
        }
        io::ErrorKind::PermissionDenied => {
            "only the user who runs the node may look: run this as that user".to_owned()
        }
        io::ErrorKind::NotADirectory => {
            "what should be its folder is a file: correct the path".to_owned()
        }
        io::ErrorKind::ConnectionReset => {
            "the node has just ended: try again after its restart".to_owned()
        }
        _ if error.raw_os_error() == Some(Errno::PROTOTYPE.raw_os_error()) => {
            "it is a socket of another kind: give the path that NodeBuilder::inspection_socket was given"
                .to_owned()
        }
        _ => format!("{error}: give the path that NodeBuilder::inspection_socket was given"),
    }
}

/// Describes a process that does not answer.
fn silence_of(peer: NodeProcess) -> String {
    let process = match peer {
        NodeProcess::Unreached => {
            return "others wait there, too: it stands still, or is looked at without end; try again"
                .to_owned();
        }
        NodeProcess::There { process: Some(process) } if is_stopped(process) => {
            return format!(
                "its process {process} is stopped; `kill -CONT {process}` lets it go on"
            );
        }
        NodeProcess::There { process: Some(process) } => format!("its process {process}"),
        NodeProcess::There { process: None } => "its process".to_owned(),
    };
    format!(
        "{process} stands still or has too much to do, or this is no inspection socket of a node; \
         try again, or give it longer by --within"
    )
}

/// Returns whether a signal or a debugger has stopped the process. Only Linux reports it.
fn is_stopped(process: i32) -> bool {
    let status = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    // The name before it, in brackets, may hold any character.
    let state = status.rsplit_once(')').and_then(|(_, rest)| rest.trim_start().chars().next());
    matches!(state, Some('T' | 't'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_nodes_picture_is_taken_for_one() {
        let whole = r#"{"node":"a","state":"running","incarnation":7,"table":[],"threads":[],
            "links":null,"faults":[]}"#;
        assert!(read(whole.into()).is_ok(), "a part that has not answered is null");

        let check = |shown: &str, words: &str| {
            let error = read(shown.into()).err().expect(shown);
            assert!(error.contains(words), "{shown}: {error}");
        };
        check("", "nothing");
        check("hello", "no JSON document");
        check(&whole[..40], "no JSON document");
        check("{}", "without \"node\"");
        check("[]", "without \"node\"");
        check("42", "without \"node\"");
        check(r#"{"node":7,"state":"running"}"#, "without \"node\"");
        check(r#"{"node":"a","state":"running"}"#, "without \"incarnation\"");
        check(&whole.replace("\"links\":null,", ""), "without \"links\"");
        check(&whole.replace("\"faults\":[]", "\"faults\":{}"), "without \"faults\"");
        let error = read(vec![0xff, 0xfe]).err();
        assert_eq!(error.as_deref(), Some("what is no text"));
    }
}

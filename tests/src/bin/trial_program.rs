//! A program for tests of supervised processes: it does what its arguments say, one after the
//! other, and launches processes of other programs.

use blastema::prelude::*;
use blastema::{ProcessSpec, launch_processes};
use std::io::Write;
use std::os::unix::net::UnixDatagram;
use std::process::{ExitCode, abort, exit};
use std::thread::{park, park_timeout};
use std::time::Duration;
use std::{env, hint};

fn main() -> ExitCode {
    launch_processes();
    let mut words = env::args().skip(1);
    while let Some(verb) = words.next() {
        let mut word = || words.next().expect("the verb has an argument");
        match verb.as_str() {
            "say" => say(word().as_bytes()),
            // So that a test can find it.
            "say-pid" => say(format!("STATUS={}", std::process::id()).as_bytes()),
            "beat" => loop {
                say(b"WATCHDOG=1");
                park_timeout(Duration::from_millis(20));
            },
            "spin" => loop {
                hint::spin_loop();
            },
            "sleep" => loop {
                park();
            },
            "abort" => abort(),
            "exit" => exit(word().parse().expect("a number")),
            // Does the rest only once in a folder.
            "once" => {
                let mark = std::path::Path::new(&word()).to_owned();
                if mark.exists() {
                    loop {
                        park();
                    }
                }
                std::fs::write(mark, "").expect("a folder");
            }
            "grow" => {
                let mut held = Vec::new();
                loop {
                    held.push(vec![1u8; 1 << 20]);
                    park_timeout(Duration::from_millis(5));
                }
            }
            "print" => {
                let lines: u64 = word().parse().expect("a number");
                let mut out = std::io::stdout().lock();
                for line in 0..lines {
                    writeln!(out, "line {line}").expect("it is read");
                }
                writeln!(out, "{}", "x".repeat(100_000)).expect("it is read");
            }
            "nonsense" => {
                let count: u64 = word().parse().expect("a number");
                (0..count).for_each(|_| say(b"NONSENSE=1\n\xff\xff\nREADY=0"));
                say(&[b'x'; 65_000]);
            }
            "host" => host(words.collect()),
            other => panic!("there is no verb {other}"),
        }
    }
    ExitCode::SUCCESS
}

fn say(message: &[u8]) {
    let at = env::var_os("NOTIFY_SOCKET").expect("it is supervised");
    let socket = UnixDatagram::unbound().expect("there are sockets");
    socket.send_to(message, at).expect("the launcher listens");
}

/// A node of this program with a process for each of these shell scripts, until it is killed or the
/// first of them has ended.
fn host(scripts: Vec<String>) -> ! {
    let own = env::current_exe().expect("a running program has a path");
    blastema::run(async {
        let mut node = Node::builder("host");
        for (number, script) in scripts.iter().enumerate() {
            let process = ProcessSpec::new(&format!("p{number}"), "sh");
            let process = process.arguments(["-c", script]).variable("PROGRAM", &own);
            node = node.child_with(process.child(), Restart::Temporary);
        }
        let node = node.start().await.expect("it starts");
        writeln!(std::io::stdout(), "started").expect("it is read");
        let first =
            blastema::ObjectAddress::new(node.name().clone(), "p0".parse().expect("a name"));
        let first = blastema::FaultLocation::Object(first);
        while node
            .table()
            .await
            .iter()
            .any(|row| row.location == first && row.state == Some(blastema::Lifecycle::Active))
        {
            blastema::sleep(Duration::from_millis(20)).await;
        }
        node.shutdown().await;
    });
    exit(0)
}

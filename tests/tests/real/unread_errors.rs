//! A reader of standard error that stands still, such as a paused terminal, holds up no recovery,
//! and is waited for at the end.

use blastema::prelude::*;
use blastema_tests::{MS, Process, addresses, role, until};
use std::fs::{self, File};
use std::io::{PipeReader, Read, Write, pipe};
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::process::exit;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::SeqCst;
use std::thread;

#[derive(Clone, Debug, Event)]
struct Fall;

static ACTIVATED: AtomicU32 = AtomicU32::new(0);

/// Panics at each message.
struct Falls;

impl Component for Falls {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Fall>();
    }

    async fn on_activated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        ACTIVATED.fetch_add(1, SeqCst);
        Ok(())
    }
}

impl Handle<Fall> for Falls {
    async fn handle(&mut self, _: Fall, _: &mut Context<Self>) {
        panic!("it falls");
    }
}

#[test]
fn a_process_plays_its_role() {
    if let Some(role) = role() {
        blastema::run(async {
            let node = Node::builder("module1").child(ChildSpec::new("falls", || Falls));
            let node = node.start().await.expect("it starts");
            let falls = node.actor::<Falls>("falls").expect("it was started");
            // It has come, and is back twice.
            while ACTIVATED.load(SeqCst) < 3 {
                let _ = falls.tell(Fall);
                sleep(10 * MS).await;
            }
            match role.as_str() {
                "exits" => exit(0),
                _ => fs::write(&addresses::<PathBuf>()[0], "").expect("a folder"),
            }
        });
    }
}

/// A full pipe, of which its writer has some more, as the standard error of a process.
fn unread() -> (PipeReader, File) {
    let (reader, writer) = pipe().expect("a pipe");
    let mut filling = writer.try_clone().expect("a second end");
    thread::spawn(move || {
        // A pipe holds 16 pages.
        for _ in 0..32 {
            let _ = filling.write_all(&[b'x'; 4096]);
        }
    });
    (reader, File::from(OwnedFd::from(writer)))
}

#[test]
fn a_component_is_restarted_while_standard_error_is_not_read() {
    let _turn = blastema_doubles::turn();
    let (reader, errors) = unread();
    let mut process = Process::start_into(errors, module_path!(), "exits", &[""; 0]);
    blastema::run(until(async || process.exit_status() == Some(0), "it is back twice"));
    drop(reader);
}

#[test]
fn the_end_of_a_program_waits_until_its_last_lines_are_read() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let mark = folder.path().join("mark");
    let (mut reader, errors) = unread();
    let mut process = Process::start_into(errors, module_path!(), "returns", &[mark.display()]);
    blastema::run(async {
        until(async || mark.exists(), "its future returns").await;
        // Without the wait it would have ended by then.
        sleep(100 * MS).await;
    });

    let mut printed = String::new();
    reader.read_to_string(&mut printed).expect("a pipe");
    assert!(process.succeeds());
    assert!(printed.contains("panic of module1:falls"), "{}", printed.trim_start_matches('x'));
}

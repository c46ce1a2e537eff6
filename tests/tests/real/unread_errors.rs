//! A reader of standard error that stands still, such as a paused terminal, holds up no recovery.

use blastema::prelude::*;
use blastema_tests::{MS, Process, role, until};
use std::fs::File;
use std::io::{Write, pipe};
use std::os::fd::OwnedFd;
use std::process::exit;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::SeqCst;
use std::thread;

#[derive(Clone, Debug, Event)]
struct Fall;

static ACTIVATED: AtomicU32 = AtomicU32::new(0);

/// Panics at each message. Its process succeeds when it is back for the second time.
struct Falls;

impl Component for Falls {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Fall>();
    }

    async fn on_activated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        if ACTIVATED.fetch_add(1, SeqCst) == 2 {
            exit(0);
        }
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
    if role().is_some() {
        blastema::run(async {
            let node = Node::builder("module1").child(ChildSpec::new("falls", || Falls));
            let node = node.start().await.expect("it starts");
            let falls = node.actor::<Falls>("falls").expect("it was started");
            loop {
                let _ = falls.tell(Fall);
                sleep(10 * MS).await;
            }
        });
    }
}

#[test]
fn a_component_is_restarted_while_standard_error_is_not_read() {
    let _turn = blastema_doubles::turn();
    let (reader, writer) = pipe().expect("a pipe");
    let mut filling = writer.try_clone().expect("a second end");
    thread::spawn(move || while filling.write_all(&[b'x'; 4096]).is_ok() {});
    let errors = File::from(OwnedFd::from(writer));
    let mut process = Process::start_into(errors, module_path!(), "unread", &[""; 0]);
    blastema::run(until(async || process.exit_status() == Some(0), "it is back twice"));
    drop(reader);
}

//! What a program is told that cannot start a node.

use blastema::prelude::*;
use blastema::{Network, run};
use std::error::Error;
use std::process::ExitCode;

#[derive(Clone, Debug, Event)]
struct Ping;

#[blastema::main]
async fn program_with_a_wrong_endpoint() -> Result<(), Box<dyn Error + Send + Sync>> {
    let bus = Network::new("bus", "serial:///dev/ttyUSB0?buad=9600");
    let _node = Node::builder("n").network(bus).start().await?;
    Ok(())
}

#[blastema::main]
async fn program_that_ends_well() -> Result<(), StartError> {
    Ok(())
}

#[test]
fn main_reports_an_error_and_fails() {
    let _turn = blastema_doubles::turn();
    assert_eq!(program_with_a_wrong_endpoint(), ExitCode::FAILURE);
    assert_eq!(program_that_ends_well(), ExitCode::SUCCESS);
}

#[test]
fn the_wrong_part_of_an_endpoint_is_underlined_in_what_main_prints() {
    let _turn = blastema_doubles::turn();
    let bus = Network::new("bus", "serial:///dev/ttyUSB0?buad=9600");
    let refused = run(async { Node::builder("n").network(bus).start().await });

    let text = refused.expect_err("the endpoint is wrong").to_string();

    let lines: Vec<&str> = text.lines().collect();
    let at = lines[1].find("buad").expect("the second line shows the endpoint");
    assert_eq!(lines[2].find("^^^^"), Some(at), "{text}");
}

#[test]
fn errors_of_sending_print_their_text_where_a_main_prints_debug() {
    let _turn = blastema_doubles::turn();
    run(async {
        let node = Node::builder("n").start().await?;
        let unknown = node.sender::<Ping>("arm").map(|_| ()).expect_err("there is no arm");
        let stopped = Box::<dyn Error>::from(unknown.clone());
        node.shutdown().await;

        assert!(unknown.to_string().contains("no object is called `arm`"), "{unknown}");
        assert_eq!(format!("{unknown:?}"), unknown.to_string());
        assert_eq!(format!("{stopped:?}"), unknown.to_string());
        Ok::<(), StartError>(())
    })
    .unwrap();
}

#[test]
fn a_node_started_outside_of_the_runtime_is_told_what_to_write() {
    let _turn = blastema_doubles::turn();
    let plain = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();

    let refused = plain.block_on(async { Node::builder("n").start().await });

    let Err(StartError::Runtime) = &refused else { panic!("{refused:?}") };
    // A `main` without Blastema's attribute prints what it returns by `Debug`.
    assert!(format!("{:?}", StartError::Runtime).contains("#[blastema::main]"));
}

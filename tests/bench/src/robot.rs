//! A robot of a thousand components from a file: its check, and its start.

use crate::measure::Table;
use blastema::prelude::*;
use blastema_robot::Types;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::time::Instant;

const COMPONENTS: usize = 1000;

/// What is ahead.
#[derive(Clone, Debug, Event)]
struct Scan {
    #[contract(unit = "m")]
    nearest: f32,
}

#[derive(Clone, Debug, Parameters)]
struct LaserParameters {
    #[parameter(default = 5.5, range = 0.1..=30.0, unit = "m")]
    reach: f32,
}

#[derive(Default)]
struct Laser;

impl Component for Laser {
    fn ports(ports: &mut Ports<Self>) {
        ports.publishes::<Scan>("scan").parameters::<LaserParameters>();
        ports.listen::<Scan>().named("before");
    }
}

impl Handle<LaserParameters> for Laser {
    async fn handle(&mut self, _: LaserParameters, _: &mut Context<Self>) {}
}

impl Handle<Scan> for Laser {
    async fn handle(&mut self, scan: Scan, _: &mut Context<Self>) {
        let _ = scan.nearest;
    }
}

/// Each component listens to the one before.
fn file(path: &Path) {
    let mut text = String::from("<robot schema=\"1\" name=\"large\">\n<node name=\"base\">\n");
    // Writing to a text does not fail.
    for at in 0..COMPONENTS {
        if at % 10 == 0 {
            let _ = writeln!(text, "<supervisor name=\"group{}\">", at / 10);
        }
        let _ = writeln!(
            text,
            "<component name=\"laser{at}\" type=\"Laser\" queue=\"16\" max-block=\"150ms\">\
             <param name=\"reach\" value=\"2.5 m\"/></component>"
        );
        if at % 10 == 9 {
            text += "</supervisor>\n";
        }
    }
    for at in 1..COMPONENTS {
        let _ = writeln!(text, "<connect from=\"laser{}#scan\" to=\"laser{at}#before\"/>", at - 1);
    }
    text += "</node>\n</robot>\n";
    fs::write(path, text).expect("it can be written");
}

pub(crate) async fn run(rounds: usize) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("large.robot.xml");
    file(&path);
    let types = Types::new().component::<Laser>("Laser");
    let mut table =
        Table::new("a robot of 1000 components and 999 connections, from its file", "ms");
    let started = |since: Instant| since.elapsed().as_secs_f64() * 1e3;
    for _ in 0..rounds {
        let since = Instant::now();
        let robot = types.load(&path, &[]).expect("it is right");
        table.add("check", started(since));
        let node = types.node(&robot, "base").expect("it is there").start().await;
        let node = node.expect("it starts");
        table.add("check and start", started(since));
        node.shutdown().await;
    }
    table.print();
}

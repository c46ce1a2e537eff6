//! Robots of a thousand components.

use crate::program::types;
use std::fmt::Write;
use std::fs;

#[test]
fn a_thousand_components_are_checked_and_started() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("large.robot.xml");
    let mut text = String::from("<robot schema=\"1\" name=\"large\">\n<node name=\"base\">\n");
    for group in 0..100 {
        let _ = writeln!(text, "<supervisor name=\"group{group}\">");
        for at in 0..10 {
            let _ = writeln!(
                text,
                "<component name=\"group{group}/laser{at}\" type=\"Laser\" queue=\"16\" \
                 max-block=\"150ms\"><param name=\"reach\" value=\"{at}.5 m\"/></component>"
            );
        }
        let _ = writeln!(text, "</supervisor>");
    }
    text += "</node>\n</robot>\n";
    fs::write(&file, text).expect("it can be written");

    let types = types();
    let tree = blastema::run(async {
        let robot = types.load(&file, &[]).expect("it is right");
        let node = types.node(&robot, "base").expect("it is there").start().await;
        let node = node.expect("it starts");
        let tree = node.tree().await.expect("it runs");
        node.shutdown().await;
        tree
    });
    assert_eq!(tree.children.len(), 100);
}

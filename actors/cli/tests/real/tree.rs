//! The program prints what editors of behaviour trees load.

use std::process::Command;

#[test]
fn the_model_of_the_leaves_that_come_with_every_tree_is_printed() {
    let _turn = blastema_doubles::turn();
    let mut program = Command::new(env!("CARGO_BIN_EXE_blastema"));
    let output = program.args(["tree", "model"]).output().expect("it starts");
    let text = String::from_utf8(output.stdout).expect("text");
    assert!(output.status.success());
    assert_eq!(text, blastema::trees::TreeLeaves::new().model());
    assert!(text.contains("<Condition ID=\"IsCommsConnected\">"), "{text}");
}

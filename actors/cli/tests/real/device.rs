//! The program writes C for a device.

use blastema::DeviceSpec;
use blastema::prelude::*;
use std::process::{Command, Output};

#[derive(Clone, Debug, Event)]
#[contract(name = "gripper/close")]
struct Close {
    #[contract(unit = "N")]
    force: f32,
    #[contract(at_most = 4)]
    note: String,
}

fn run(arguments: &[&str]) -> Output {
    let mut program = Command::new(env!("CARGO_BIN_EXE_blastema"));
    program.args(arguments).output().expect("the program can be started")
}

#[test]
fn header_and_example_of_a_firmware_are_written_from_a_description() {
    let _turn = blastema_doubles::turn();
    let gripper = DeviceSpec::new("gripper", "serial:///dev/ttyUSB0", 0x6772_6970);
    let device = gripper.accepts::<Close>(0).describe().expect("the spec is right");
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("gripper.json");
    let file = file.to_str().expect("a path of letters");
    std::fs::write(file, device.to_json()).expect("a file");

    let header = run(&["device", "header", file]);
    assert!(header.status.success(), "{header:?}");
    let header = String::from_utf8(header.stdout).expect("text");
    assert_eq!(header, device.header());
    assert!(header.contains("        uint8_t item[4];\n    } note;"), "{header}");
    let firmware = run(&["device", "firmware", file]);
    assert_eq!(String::from_utf8(firmware.stdout).expect("text"), device.firmware());

    let described = format!("{{\"types\":{{\"Gripper\":{{\"device\":{}}}}}}}", device.to_json());
    std::fs::write(file, described).expect("a file");
    let of_type = run(&["device", "header", file, "--type", "Gripper"]);
    assert_eq!(String::from_utf8(of_type.stdout).expect("text"), device.header());
    let other = run(&["device", "header", file, "--type", "Laser"]);
    let text = String::from_utf8(other.stderr).expect("text");
    assert!(text.contains("it has no type of devices `Laser`: write the file"), "{text}");

    std::fs::write(file, "{\"name\":\"gripper\"}").expect("a file");
    let wrong = run(&["device", "header", file]);
    let text = String::from_utf8(wrong.stderr).expect("text");
    assert_eq!(wrong.status.code(), Some(2));
    assert!(text.contains("gripper.json: missing field `device_type`"), "{text}");
    assert!(text.contains("write the file by `DeviceSpec::describe`"), "{text}");
}

//! A build in which no panic can be caught is refused, since it would keep none of the promises.

use std::path::Path;
use std::process::Command;

/// What the compiler says to the facade's own source under a panic strategy. Nothing that the
/// facade depends on is given to it, so it complains of much besides: only the refusal is looked
/// for.
fn compile(strategy: &str) -> String {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new("rustc")
        .args(["--edition", "2024", "--crate-type", "lib", "--emit", "metadata"])
        .args(["-C", &format!("panic={strategy}"), "--out-dir", env!("CARGO_TARGET_TMPDIR")])
        .arg(root.join("../actors/src/lib.rs"))
        .output()
        .expect("the compiler that built this test can be started");
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_build_whose_panics_abort_is_refused_with_the_cure() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    let refused = compile("abort");
    let taken = compile("unwind");

    assert!(refused.contains("error: Blastema recovers from panics"), "{refused}");
    assert!(refused.contains("set `panic = \"unwind\"`"), "{refused}");
    assert!(!taken.contains("Blastema recovers"), "{taken}");
}

//! The `TreeNodesModel`: written for editors, and compared with the program.

use blastema_trees::{Factory, Leaf, LeafContext, LeafResult, Port, Status};
use std::process::Command;

/// Two leaves with ports of all kinds.
fn factory() -> Factory {
    struct Drive;
    impl Leaf for Drive {
        fn ports() -> Vec<Port> {
            vec![
                Port::input::<f64>("speed").or("0.5").about("in m/s, < 2"),
                Port::inout::<Vec<i32>>("path"),
                Port::output::<bool>("arrived"),
            ]
        }
        fn start(&mut self, _: &mut LeafContext<'_>) -> LeafResult {
            Ok(Status::Running)
        }
    }
    let mut factory = Factory::new();
    factory.leaf("Drive", || Drive);
    factory.condition("IsNear", [Port::input::<String>("what")], |_| Ok(Status::Success));
    factory
}

const MODEL: &str = r#"<root BTCPP_format="4">
  <TreeNodesModel>
    <Action ID="Drive">
      <input_port name="speed" type="double" default="0.5">in m/s, &lt; 2</input_port>
      <inout_port name="path" type="std::vector&lt;int&gt;"></inout_port>
      <output_port name="arrived" type="bool"></output_port>
    </Action>
    <Condition ID="IsNear">
      <input_port name="what" type="std::string"></input_port>
    </Condition>
  </TreeNodesModel>
</root>
"#;

#[test]
fn the_model_of_a_program_has_its_leaves_with_ports_types_and_defaults() {
    assert_eq!(factory().model(), MODEL);
}

#[test]
fn a_file_with_the_programs_own_model_loads() {
    let tree = r#"<BehaviorTree ID="Main"><Drive path="{path}"/></BehaviorTree></root>"#;

    let tree = factory().load("test.xml", &MODEL.replace("</root>", tree)).unwrap();

    assert_eq!(tree.nodes().count(), 1);
}

#[test]
fn a_port_of_a_model_that_the_program_does_not_have_is_an_error() {
    let text = r#"<root><BehaviorTree ID="Main"><AlwaysSuccess/></BehaviorTree>
<TreeNodesModel><Action ID="Drive"><input_port name="sped"/></Action>
<Action ID="OfAnotherProgram"><input_port name="x"/></Action></TreeNodesModel></root>"#;

    let errors = factory().load("test.xml", text).err().unwrap();

    let expected = "test.xml:2:54: `Drive` has no port `sped`; did you mean `speed`?\n";
    assert!(errors.to_string().starts_with(expected), "{errors}");
    assert_eq!(errors.iter().count(), 1);
}

/// With `BLASTEMA_LONG=1` where `BLASTEMA_PYTHON`, or `python3`, has the library.
#[test]
fn the_real_library_takes_the_model_where_it_is_installed() {
    let python = std::env::var("BLASTEMA_PYTHON").unwrap_or_else(|_| "python3".into());
    let installed = Command::new(&python).args(["-c", "import behaviortreepy"]).output();
    let installed = installed.is_ok_and(|output| output.status.success());
    if std::env::var_os("BLASTEMA_LONG").is_none() || !installed {
        return;
    }
    let path = std::env::temp_dir().join(format!("blastema-model-{}.xml", std::process::id()));
    let tree = r#"<BehaviorTree ID="Main"><AlwaysSuccess/></BehaviorTree></root>"#;
    std::fs::write(&path, factory().model().replace("</root>", tree)).unwrap();

    let output = Command::new(&python)
        .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/oracle/record.py"))
        .args(["model".as_ref(), path.as_os_str()])
        .output()
        .unwrap();

    std::fs::remove_file(&path).unwrap();
    assert_eq!(String::from_utf8_lossy(&output.stdout), "taken\n");
}

//! Parameters: where their values come from, who refuses them, and who is told of a change.

use blastema::prelude::*;
use blastema::{NodeBuilder, ParameterError, ParameterValue, SpecError};
use blastema_testkit::TestNode;
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[derive(Clone, Debug, PartialEq, Parameters)]
#[contract(name = "arm/parameters")]
struct ArmParameters {
    #[parameter(default = 0.5, range = 0.0..=2.0, unit = "m/s")]
    max_speed: f64,
    #[parameter(default = 3, range = 1..)]
    attempts: u8,
    #[parameter(default = "map")]
    frame: String,
    careful: bool,
    #[parameter(range = -1.0..=1.0, unit = "rad")]
    joints: Vec<f64>,
    grips: Vec<Grip>,
    grip: Grip,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, ParameterType)]
enum Grip {
    #[default]
    Soft,
    Firm,
}

type Seen = Arc<Mutex<Vec<ArmParameters>>>;

/// Takes this long to initialize.
struct Arm(Seen, Duration);

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        ports.parameters::<ArmParameters>();
        ports.accept::<Blow>();
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.0.lock().unwrap().push(cx.parameters()?);
        tokio::time::sleep(self.1).await;
        Ok(())
    }
}

impl Handle<ArmParameters> for Arm {
    async fn handle(&mut self, parameters: ArmParameters, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(parameters);
    }
}

#[derive(Clone, Debug, Event)]
struct Blow;

impl Handle<Blow> for Arm {
    async fn handle(&mut self, _: Blow, _: &mut Context<Self>) {
        panic!("a blow");
    }
}

fn arm_that_takes(takes: Duration) -> (ChildSpec<Arm>, Seen) {
    let seen = Seen::default();
    let kept = seen.clone();
    (ChildSpec::new("arm", move || Arm(kept.clone(), takes)), seen)
}

fn arm() -> (NodeBuilder, Seen) {
    let (spec, seen) = arm_that_takes(Duration::ZERO);
    (Node::builder("module1").child(spec), seen)
}

fn speeds(seen: &Seen) -> Vec<f64> {
    seen.lock().unwrap().iter().map(|parameters| parameters.max_speed).collect()
}

#[blastema_testkit::test]
async fn parameters_have_their_defaults_unless_the_configuration_says_otherwise() {
    let (builder, seen) = arm();
    let _node = TestNode::start(builder).await;
    let expected = ArmParameters {
        max_speed: 0.5,
        attempts: 3,
        frame: "map".into(),
        careful: false,
        joints: vec![],
        grips: vec![],
        grip: Grip::Soft,
    };
    assert_eq!(seen.lock().unwrap().as_slice(), std::slice::from_ref(&expected));

    let (builder, seen) = arm();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("robot.toml");
    std::fs::write(&file, "[arm]\nmax_speed = 1\nframe = \"odom\"\n").unwrap();
    let builder = builder.parameters_from(file).parameters("[arm]\nattempts = 9\ncareful = true");
    let _node = TestNode::start(builder).await;
    let expected = ArmParameters {
        max_speed: 1.0,
        attempts: 9,
        frame: "odom".into(),
        careful: true,
        ..expected
    };
    assert_eq!(*seen.lock().unwrap(), [expected]);
}

/// By a description, whose values are texts, by a file, and while the component runs.
#[blastema_testkit::test]
async fn a_parameter_may_be_a_list_or_a_variant_by_its_name_wherever_it_is_given() {
    let (spec, seen) = arm_that_takes(Duration::ZERO);
    let spec = spec.parameter("joints", "[0.5, -1] rad").parameter("grips", "[Firm,Soft]");
    let builder = Node::builder("module1").child(spec).parameters("[arm]\ngrip = \"Firm\"");
    let node = TestNode::start(builder).await;
    let parameters = node.variable::<ArmParameters>("arm").unwrap();
    let begun = seen.lock().unwrap()[0].clone();
    assert_eq!((&*begun.joints, &*begun.grips), (&[0.5, -1.0][..], &[Grip::Firm, Grip::Soft][..]));
    assert_eq!(begun.grip, Grip::Firm);

    let numbers = ParameterValue::List(vec![ParameterValue::Integer(1)]);
    parameters.set("joints", numbers).await.unwrap();
    parameters.set("grip", ParameterValue::Text("Soft".into())).await.unwrap();
    node.settle().await;

    let set = seen.lock().unwrap().last().cloned().unwrap();
    assert_eq!((set.joints, set.grip), (vec![1.0], Grip::Soft));
    assert_eq!(set.grips, begun.grips, "the others stay");
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn a_parameter_that_is_set_is_told_to_its_component_and_outlives_it() {
    let (builder, seen) = arm();
    let mut node = TestNode::start(builder).await;
    let parameters = node.variable::<ArmParameters>("arm").unwrap();

    parameters.set("max_speed", ParameterValue::Float(1.5)).await.unwrap();
    node.settle().await;
    assert_eq!(speeds(&seen), [0.5, 1.5]);
    assert_eq!(parameters.read().await.unwrap().value.attempts, 3);

    node.sender("arm").unwrap().tell(Blow).unwrap();
    node.await_recovered(FaultKind::Panic, "arm").await;
    assert_eq!(speeds(&seen), [0.5, 1.5, 1.5]);
}

/// Set one after the other while the next incarnation begins, which reads one of the first.
#[blastema_testkit::test]
async fn a_component_runs_with_the_newest_parameters_however_many_are_set_during_its_restart() {
    let (spec, seen) = arm_that_takes(Duration::from_secs(1));
    let spec = spec.queue(8, WhenFull::Refuse);
    let mut node = TestNode::start(Node::builder("module1").child(spec)).await;
    let parameters = node.variable::<ArmParameters>("arm").unwrap();

    node.sender("arm").unwrap().tell(Blow).unwrap();
    for tenths in 0..20 {
        parameters.set("max_speed", ParameterValue::Float(f64::from(tenths) / 10.0)).await.unwrap();
        node.advance(Duration::from_millis(10)).await;
    }
    node.await_recovered(FaultKind::Panic, "arm").await;
    node.advance(Duration::from_secs(1)).await;

    assert_eq!(parameters.read().await.unwrap().value.max_speed, 1.9);
    assert_eq!(speeds(&seen).last(), Some(&1.9), "{:?}", speeds(&seen));
    assert_eq!(node.dead_letters().total(), 1, "the blow");
}

#[blastema_testkit::test]
async fn what_a_parameter_does_not_take_is_refused_with_the_reason_and_changes_nothing() {
    let (builder, seen) = arm();
    let node = TestNode::start(builder).await;
    let parameters = node.variable::<ArmParameters>("arm").unwrap();

    for (key, value, reason) in [
        ("max_speed", ParameterValue::Float(2.5), "0.0..=2.0 m/s"),
        ("max_speed", ParameterValue::Float(f64::NAN), "0.0..=2.0 m/s"),
        ("max_sped", ParameterValue::Float(1.0), "`max_speed`"),
        ("attempts", ParameterValue::Integer(256), "a whole number from 0 to 255, in 1.."),
        ("attempts", ParameterValue::Integer(0), "1.."),
        ("careful", ParameterValue::Text("yes".into()), "true or false"),
        ("joints", ParameterValue::Float(0.1), "a list in `[]`, each a number"),
        ("joints", ParameterValue::List(vec![ParameterValue::Float(2.0)]), "-1.0..=1.0 rad"),
        (
            "grip",
            ParameterValue::Text("soft".into()),
            "`grip` is \"soft\", and must be one of `Soft`",
        ),
    ] {
        let refused = parameters.set(key, value).await.unwrap_err();
        let DeliveryError::CheckFailed { reason: told } = &refused else { panic!("{refused}") };
        assert!(told.contains(reason), "{told}");
    }
    let whole = ArmParameters { max_speed: 9.0, ..ArmParameters::default() };
    assert!(matches!(parameters.write(whole).await, Err(DeliveryError::CheckFailed { .. })));

    node.settle().await;
    assert_eq!(speeds(&seen), [0.5]);
}

#[blastema_testkit::test]
async fn a_configuration_that_nobody_takes_is_refused_before_anything_starts() {
    let refused = async |toml: &str| {
        let (builder, seen) = arm();
        let Err(error) = TestNode::try_start(builder.parameters(toml)).await else {
            panic!("{toml} was taken")
        };
        assert_eq!(speeds(&seen), [0.0; 0]);
        error
    };

    let StartError::Spec(SpecError::Parameters { name, error, .. }) =
        refused("[arm]\nmax_sped = 1.0").await
    else {
        panic!("it names the component")
    };
    assert_eq!(name.as_str(), "arm");
    let ParameterError::Unknown { nearest, .. } = error else { panic!("{error}") };
    assert_eq!(nearest.as_deref(), Some("max_speed"));
    for (toml, named) in [
        ("[amr]\nmax_speed = 1.0", "`arm`"),
        ("max_speed = 1.0", "`max_speed`"),
        ("[arm]\njoints = [{}]", "a table"),
        ("[arm]\nmax_speed = ", "line 2"),
    ] {
        let error = refused(toml).await;
        assert!(matches!(error, StartError::Parameters { file: None, .. }), "{error}");
        assert!(error.to_string().contains(named), "{error}");
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("robot.toml");
    std::fs::write(&file, "[arm]\nmax_speed = 9\nattempts = 2\n").unwrap();
    let in_file = format!("parameters of arm in {}: `max_speed` is 9.0", file.display());
    for (text, named) in [
        ("[arm]\nmax_speed = [8]", "`max_speed` is [8], and must be a number"),
        (
            "[arm]\nmax_speed = 1\ngrip = \"Hard\"",
            "`grip` is \"Hard\", and must be one of `Soft`, `Firm`",
        ),
        ("[arm]\nframe = \"odom\"", &*in_file),
        ("[arm]\nmax_speed = 8", "parameters of arm: `max_speed` is 8.0"),
    ] {
        let (builder, _) = arm();
        let refused = builder.parameters_from(&file).parameters(text);
        let error = TestNode::try_start(refused).await.err().expect("it is out of range");
        assert!(error.to_string().contains(named), "{error}");
    }
    std::fs::write(&file, "[amr]\nattempts = 2\n").unwrap();
    let (builder, _) = arm();
    let refused = TestNode::try_start(builder.parameters_from(&file)).await;
    let error = refused.err().expect("no component is called so").to_string();
    assert!(error.contains("`arm`") && error.contains(&*file.to_string_lossy()), "{error}");
    let (builder, _) = arm();
    let missing = TestNode::try_start(builder.parameters_from("/nowhere/robot.toml")).await;
    assert!(matches!(missing, Err(StartError::Parameters { file: Some(_), .. })));
}

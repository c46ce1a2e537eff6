//! Parameters: defaults, units and ranges in one struct, values from a configuration, and changes
//! while the component runs. What a parameter does not take is refused with the reason.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::ParameterValue;
use blastema::prelude::*;

/// How the arm moves.
#[derive(Clone, Debug, Parameters)]
#[contract(name = "arm/parameters")]
struct ArmParameters {
    #[parameter(default = 0.5, range = 0.0..=2.0, unit = "m/s")]
    max_speed: f64,
    #[parameter(default = 3, range = 1..=10)]
    attempts: u8,
}

struct Arm {
    parameters: ArmParameters,
}

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        ports.parameters::<ArmParameters>();
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.parameters = cx.parameters()?;
        println!("begins with {} m/s", self.parameters.max_speed);
        Ok(())
    }
}

impl Handle<ArmParameters> for Arm {
    async fn handle(&mut self, parameters: ArmParameters, _: &mut Context<Self>) {
        println!("goes on with {} m/s, {} attempts", parameters.max_speed, parameters.attempts);
        self.parameters = parameters;
    }
}

/// Usually a file, which `NodeBuilder::parameters_from` reads.
const ROBOT: &str = "
[arm]
max_speed = 1.5
";

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arm = || Arm { parameters: ArmParameters::default() };
    let node = Node::builder("module1")
        .child(ChildSpec::new("arm", arm))
        .parameters(ROBOT)
        .start()
        .await?;
    let parameters = node.variable::<ArmParameters>("arm")?;

    parameters.set("max_speed", ParameterValue::Float(0.8)).await?;
    for (key, value) in [("max_speed", 5.0), ("max_sped", 1.0)] {
        if let Err(why) = parameters.set(key, ParameterValue::Float(value)).await {
            println!("{why}");
        }
    }

    let wrong = Node::builder("module2")
        .child(ChildSpec::new("arm", arm))
        .parameters("[arm]\nattempts = \"many\"")
        .start()
        .await;
    if let Err(error) = wrong {
        println!("{error}");
    }
    node.shutdown().await;
    Ok(())
}

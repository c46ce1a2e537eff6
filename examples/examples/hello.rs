//! The program of the README: a component is killed by a request, and the same sender reaches its
//! next incarnation.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;

/// Asks how near the nearest thing is.
#[derive(Debug, Request)]
#[contract(name = "laser/nearest", version = 1, reply = f32)]
struct Nearest {
    /// To either side of straight ahead.
    #[contract(unit = "rad")]
    within: f32,
}

/// A laser scanner.
struct Laser {
    ranges: Vec<f32>,
}

impl Component for Laser {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Nearest>();
    }
}

impl Handle<Nearest> for Laser {
    async fn handle(&mut self, request: Nearest, _: &mut Context<Self>) -> f32 {
        assert!(request.within > 0.0, "nothing can be seen within {} rad", request.within);
        self.ranges.iter().copied().fold(f32::INFINITY, f32::min)
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let node = Node::builder("module1")
        .child(ChildSpec::new("laser", || Laser { ranges: vec![2.5, 0.8] }))
        .start()
        .await?;
    let laser: Sender<Nearest> = node.sender("laser")?;

    if let Err(error) = laser.ask(Nearest { within: 0.0 }).await {
        println!("{error}"); // … the receiver died in its incarnation #1 while it served this message
    }
    println!("{} m", laser.ask(Nearest { within: 0.1 }).await?);
    node.shutdown().await;
    Ok(())
}

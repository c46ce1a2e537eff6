//! A cell of the robot's skin: one of a hundred small objects. Some receive a flow.

use super::harm::{HarmState, declare, vulnerable};
use super::measurements::Measurements;
use super::messages::Numbered;
use crate::flow_receiver::Sample;
use crate::machine_instant::MachineInstant;
use crate::robot::Flow;
use blastema::prelude::*;

/// Feels pressure, ten times a second.
#[derive(Debug)]
pub(super) struct Cell {
    pub(super) harm: HarmState,
    pub(super) measurements: Measurements,
    /// The flow that ends here.
    pub(super) flow: Option<&'static Flow>,
    pub(super) pressure: f32,
}

impl Component for Cell {
    fn ports(ports: &mut Ports<Self>) {
        declare(ports);
        ports.accept::<Numbered>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.initialize()
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.pressure = 0.9 * self.pressure + 0.01;
        cx.check_range("pressure", &self.pressure, 0.0..1.0);
        self.harm.execute()
    }
}

impl Handle<Numbered> for Cell {
    async fn handle(&mut self, numbered: Numbered, _: &mut Context<Self>) {
        let Numbered { epoch, number, made_ns } = numbered;
        if let Some(flow) = self.flow {
            let sample = Sample { epoch, number, sent: MachineInstant::from_nanos(made_ns) };
            self.measurements.arrived(flow, sample);
        }
    }
}

vulnerable!(Cell);

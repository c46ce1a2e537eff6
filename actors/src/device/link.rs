//! What the proxy of a device and the line share: orders one way, the device's status the other.

use crate::platform::{self, lock};
use blastema_core::{DeliveryError, Instant};
use blastema_lite::{
    CommandError, CommandOutcome, DeviceCommand, Host, HostConfig, LifecycleChange, Mismatch, Port,
    Status,
};
use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;
use tokio::sync::{Notify, oneshot, watch};

/// Takes the packed value of an out port.
pub(super) type Receive = Box<dyn Fn(&[u8]) + Send + Sync>;

/// A command to the device, with its data.
#[derive(Clone, Debug)]
pub(super) enum DeviceOrder {
    Change(u8, LifecycleChange),
    Rate(u8, u16),
    Write(usize, Vec<u8>),
    Call(usize, Vec<u8>),
}

impl DeviceOrder {
    pub(super) fn give(&self, host: &mut Host<Vec<Port>>) -> Result<(), CommandError> {
        host.handle_command(match self {
            DeviceOrder::Change(object, change) => DeviceCommand::Change(*object, *change),
            DeviceOrder::Rate(object, period_ms) => DeviceCommand::Rate(*object, *period_ms),
            DeviceOrder::Write(port, bytes) => DeviceCommand::Write(*port, bytes),
            DeviceOrder::Call(port, bytes) => DeviceCommand::Call(*port, bytes),
        })
    }
}

/// How a command ended, and the payload of its reply.
pub(super) type OrderOutcome = (CommandOutcome, Vec<u8>);

/// A command that waits for its turn, and where its outcome goes.
pub(super) type PendingOrder = (DeviceOrder, oneshot::Sender<OrderOutcome>);

/// How far the device can be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum DevicePhase {
    /// It does not answer, for this reason.
    Absent(String),
    Serving,
    /// Another device, or another contract.
    Refused(Mismatch),
    /// The line serves this proxy no more: it hung, or another one has taken its place.
    Released,
}

/// What the line knows of a device.
#[derive(Clone, Debug)]
pub(super) struct DeviceStatus {
    pub(super) phase: DevicePhase,
    /// How often the chip was reset since the proxy found it, and why the last time.
    pub(super) resets: (u32, String),
    /// An object of it is in Error by itself.
    pub(super) fault: Option<String>,
}

#[derive(Default)]
struct Orders {
    /// One of each handler and of each variable at most.
    waiting: VecDeque<PendingOrder>,
    /// The newest value of each in port that was not sent yet.
    values: BTreeMap<usize, Vec<u8>>,
}

/// One incarnation of a proxy at its line.
pub(super) struct DeviceLink {
    pub(super) config: HostConfig<Vec<Port>>,
    /// Indexed by the number of the port.
    pub(super) receivers: Vec<Option<Receive>>,
    pub(super) status: watch::Sender<DeviceStatus>,
    orders: Mutex<Orders>,
    /// When the proxy last had its turn, in nanoseconds; `INACTIVE` while it is not at work.
    served_at: AtomicU64,
    changed: Arc<Notify>,
}

const INACTIVE: u64 = u64::MAX;

impl DeviceLink {
    pub(super) fn new(
        config: HostConfig<Vec<Port>>,
        receivers: Vec<Option<Receive>>,
        changed: Arc<Notify>,
    ) -> Self {
        let phase = DevicePhase::Absent("it has not answered yet".to_owned());
        let resets = (0, String::new());
        let status = DeviceStatus { phase, resets, fault: None };
        DeviceLink {
            config,
            receivers,
            status: watch::Sender::new(status),
            orders: Mutex::default(),
            served_at: AtomicU64::new(INACTIVE),
            changed,
        }
    }

    fn orders(&self) -> MutexGuard<'_, Orders> {
        lock(&self.orders)
    }

    /// Sends the newest value of an in port, once.
    pub(super) fn publish(&self, port: usize, value: Vec<u8>) {
        self.orders().values.insert(port, value);
        self.changed.notify_one();
    }

    /// The values that are to be announced.
    pub(super) fn take_values(&self) -> BTreeMap<usize, Vec<u8>> {
        std::mem::take(&mut self.orders().values)
    }

    pub(super) fn next_order(&self) -> Option<PendingOrder> {
        self.orders().waiting.pop_front()
    }

    pub(super) fn put_back(&self, order: PendingOrder) {
        self.orders().waiting.push_front(order);
    }

    /// Gives the device a command. Returns the payload of a reply that says well.
    pub(super) async fn order(&self, order: DeviceOrder) -> Result<Vec<u8>, DeliveryError> {
        match self.outcome(order).await {
            (CommandOutcome::Replied(Status::Well), payload) => Ok(payload),
            (CommandOutcome::Replied(status), _) => {
                let reason = format!("the device has answered {status:?}");
                Err(DeliveryError::CheckFailed { reason })
            }
            (CommandOutcome::NotSent, _) => Err(DeliveryError::Restarting),
            (CommandOutcome::Unknown, _) => {
                let reason = "the device was reset or lost while it had the command".to_owned();
                Err(DeliveryError::OutcomeUnknown { reason })
            }
        }
    }

    /// Gives the device a command and waits for its end, which comes: a device that does not
    /// answer is lost.
    pub(super) async fn outcome(&self, order: DeviceOrder) -> OrderOutcome {
        let (give, mut outcome) = oneshot::channel();
        self.orders().waiting.push_back((order, give));
        self.changed.notify_one();
        loop {
            // That the future is polled shows that the proxy's arbiter works.
            self.served();
            match tokio::time::timeout(self.config.interval, &mut outcome).await {
                Ok(outcome) => return outcome.unwrap_or((CommandOutcome::Unknown, Vec::new())),
                Err(_) if self.status.borrow().phase == DevicePhase::Released => {
                    return (CommandOutcome::Unknown, Vec::new());
                }
                Err(_) => {}
            }
        }
    }

    /// The proxy is at work, or is not.
    pub(super) fn set_active(&self, active: bool) {
        let now = if active { platform::now().as_nanos() } else { INACTIVE };
        self.served_at.store(now, Relaxed);
    }

    pub(super) fn is_active(&self) -> bool {
        self.served_at.load(Relaxed) != INACTIVE
    }

    /// The proxy has had its turn.
    pub(super) fn served(&self) {
        if self.is_active() {
            self.set_active(true);
        }
    }

    /// How long the proxy at work has had no turn.
    pub(super) fn unserved_for(&self, now: Instant) -> Duration {
        match self.served_at.load(Relaxed) {
            INACTIVE => Duration::ZERO,
            at => now - Instant::from_nanos(at),
        }
    }

    pub(super) fn set_phase(&self, phase: DevicePhase) {
        self.status.send_if_modified(|status| {
            let differs = status.phase != phase && status.phase != DevicePhase::Released;
            if differs {
                status.phase = phase;
            }
            differs
        });
    }

    /// The first fault stands until the proxy takes it.
    pub(super) fn set_fault(&self, text: String) {
        self.status.send_modify(|status| {
            status.fault.get_or_insert(text);
        });
    }

    pub(super) fn clear_fault(&self) {
        self.status.send_modify(|status| status.fault = None);
    }

    /// Ends the use of the line.
    pub(super) fn release(&self) {
        self.set_phase(DevicePhase::Released);
        // A handler that waits for an outcome gets it when its sender is dropped.
        self.orders().waiting.clear();
        self.changed.notify_one();
    }
}

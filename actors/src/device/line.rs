//! One line with its devices: it gives the turns, reopens the port, and reports to the proxies.
//!
//! ```text
//!  proxy ─ orders ─► DeviceLink ─► ┐                    ┌─► device 7
//!                                  Line, HostLine ═ port ═
//!  proxy ◄─ status ─ DeviceLink ◄─ ┘                    └─► device 8
//! ```
//!
//! A line has a thread of its own, so that a busy component delays no device. It keeps its port
//! open while a device is declared for it: many chips take the opening of a port for a reset.

use super::link::{DeviceLink, DevicePhase, OrderOutcome, PendingOrder};
use super::medium::{DeviceMedium, OpenLine};
use crate::platform::{self, lock};
use blastema_core::Instant;
use blastema_lite::{
    CommandError, CommandOutcome, DeviceCommand, DeviceState, FRAME_MAX, Host, HostEvent, HostLine,
    Port, message,
};
use std::collections::BTreeMap;
use std::future::pending;
use std::io;
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;
use tokio::sync::{Notify, oneshot};
use tokio::time::sleep_until;
use tracing::{debug, warn};

/// A port is tried again after this, and after twice as long each time up to [`REOPEN_MAX`].
const REOPEN_FIRST: Duration = Duration::from_millis(10);
/// A device that was plugged in again is found within this.
const REOPEN_MAX: Duration = Duration::from_secs(1);
/// Devices are absent when the port takes no byte for so long beyond the time of a frame: no more
/// than a few frames are unsent, of which the system holds four kilobytes.
const WRITE_MAX: Duration = Duration::from_millis(100);
/// A port that takes no byte for so long is closed, and opened again.
const WRITE_END: Duration = Duration::from_secs(5);
/// Why the devices of such a line are absent.
const PORT_FULL: &str = "the port takes no bytes: look whether its handshake lines hold it back";
/// The line looks after its proxies at least so often.
const LOOK: Duration = Duration::from_millis(100);

/// The lines of the process: a port has one user.
static LINES: Mutex<Vec<Weak<DeviceLine>>> = Mutex::new(Vec::new());

/// A line, for as long as a device is declared for it.
pub(super) struct DeviceLine {
    medium: DeviceMedium,
    pub(super) changed: Arc<Notify>,
    attached: Arc<Mutex<Attached>>,
    /// By the node that has declared the device.
    claims: Mutex<Vec<(usize, Weak<LineClaim>)>>,
}

/// A device's right to its address on a line.
pub(super) struct LineClaim {
    address: Option<u8>,
    state: Mutex<AddressHold>,
}

/// Which other devices may have the address.
#[derive(Clone, Copy)]
enum AddressHold {
    /// None of the same node.
    Declared,
    /// None: the component works.
    Held,
    /// Any: the component has ended.
    Released,
}

impl LineClaim {
    pub(super) fn new(address: Option<u8>) -> Arc<Self> {
        Arc::new(LineClaim { address, state: Mutex::new(AddressHold::Declared) })
    }

    pub(super) fn release(&self) {
        *lock(&self.state) = AddressHold::Released;
    }
}

#[derive(Default)]
struct Attached {
    links: Vec<Arc<DeviceLink>>,
    /// The thread of the line serves them.
    is_served: bool,
    /// No device is declared any more.
    ended: bool,
}

impl DeviceLine {
    /// The line at this medium.
    ///
    /// # Errors
    /// Another device is declared for the same port with other settings.
    pub(super) fn of(medium: &DeviceMedium) -> Result<Arc<DeviceLine>, String> {
        let mut lines = lock(&LINES);
        lines.retain(|line| line.strong_count() > 0);
        for line in lines.iter().filter_map(Weak::upgrade) {
            match (&line.medium, medium) {
                (known, wanted) if known == wanted => return Ok(line),
                (DeviceMedium::Serial(known), DeviceMedium::Serial(wanted))
                    if known.path == wanted.path =>
                {
                    let path = known.path.display();
                    return Err(format!(
                        "the devices of {path} have different settings of the port"
                    ));
                }
                _ => {}
            }
        }
        let (medium, changed, attached) = (medium.clone(), Arc::default(), Arc::default());
        let line = Arc::new(DeviceLine { medium, changed, attached, claims: Mutex::default() });
        lines.push(Arc::downgrade(&line));
        Ok(line)
    }

    /// Claims an address for a device of a node, which has this number.
    ///
    /// # Errors
    /// Another device has it.
    pub(super) fn claim(&self, claim: &Arc<LineClaim>, node: usize) -> Result<(), String> {
        let mut claims = lock(&self.claims);
        claims.retain(|(_, claim)| claim.strong_count() > 0);
        for (of, other) in claims.iter() {
            let Some(other) = other.upgrade() else { continue };
            let is_taken = match *lock(&other.state) {
                AddressHold::Declared => *of == node,
                AddressHold::Held => true,
                AddressHold::Released => false,
            };
            match (claim.address, other.address) {
                _ if !is_taken => {}
                (Some(own), Some(other)) if own == other => {
                    return Err(format!(
                        "another device of its line has the address {own}: give each its own, in \
                         its firmware and by `address`"
                    ));
                }
                (Some(_), Some(_)) => {}
                _ => {
                    return Err("another device is declared for its line: several devices of a \
                                line have an address each, in their firmware and by `address`"
                        .to_owned());
                }
            }
        }
        claims.push((node, Arc::downgrade(claim)));
        Ok(())
    }

    /// Serves a proxy from now on. An earlier one of the same device is served no more.
    ///
    /// # Errors
    /// The system has no thread left, or the line is too slow for its devices.
    pub(super) fn attach(&self, link: Arc<DeviceLink>, claim: &LineClaim) -> io::Result<()> {
        let mut attached = lock(&self.attached);
        let same = |other: &Arc<DeviceLink>| other.config.address == link.config.address;
        attached.links.iter().filter(|other| same(other)).for_each(|other| other.release());
        attached.links.retain(|other| other.status.borrow().phase != DevicePhase::Released);
        // One that has the line to itself is asked as often as it answers.
        let shares = |link: &&Arc<DeviceLink>| link.config.address.is_some();
        let all = attached.links.iter().chain([&link]).filter(shares);
        let round: Duration = all.clone().map(|link| link.config.slot()).sum();
        if let Some(short) = all.map(|link| link.config.interval).find(|each| *each < round) {
            return Err(io::Error::other(format!(
                "the devices of the line take {round:?} in turn, and one is to be asked every \
                 {short:?}: raise its interval or the baud rate, or lower the turnaround"
            )));
        }
        if !attached.is_served {
            // The service locks what is attached when it is dropped: the thread comes first.
            let arbiter = platform::own_arbiter()?;
            attached.is_served = true;
            let (medium, changed) = (self.medium.clone(), self.changed.clone());
            arbiter.spawn(LineService::new(medium, changed, self.attached.clone()).run());
        }
        attached.links.push(link);
        *lock(&claim.state) = AddressHold::Held;
        self.changed.notify_one();
        Ok(())
    }
}

impl Drop for DeviceLine {
    fn drop(&mut self) {
        lock(&self.attached).ended = true;
        self.changed.notify_one();
    }
}

/// A command that the device has.
enum InFlight {
    Order(oneshot::Sender<OrderOutcome>),
    /// The text of a fault is asked for.
    Text(u8, u8),
}

/// What the line keeps of a device beside its host.
struct Client {
    link: Arc<DeviceLink>,
    in_flight: Option<InFlight>,
    /// A fault whose text is not asked for yet.
    unsent: Option<(u8, u8)>,
    values: BTreeMap<usize, Vec<u8>>,
    greeted: bool,
}

/// Serves the devices of one line on its own thread.
struct LineService {
    medium: DeviceMedium,
    changed: Arc<Notify>,
    attached: Arc<Mutex<Attached>>,
    clients: Vec<Client>,
    /// In the order of the clients.
    hosts: Vec<Host<Vec<Port>>>,
    line: HostLine,
    port: Option<OpenLine>,
    /// The rest of a frame, and since when the port takes none of it.
    unsent: (Vec<u8>, Instant),
    reopen: (Instant, Duration),
}

impl Drop for LineService {
    /// Also after a panic: then the proxies restart, and their line with another thread.
    fn drop(&mut self) {
        let mut attached = lock(&self.attached);
        attached.is_served = false;
        attached.links.drain(..).for_each(|link| link.release());
    }
}

fn since(now: Instant) -> Duration {
    now - Instant::ORIGIN
}

impl LineService {
    fn new(
        medium: DeviceMedium,
        changed: Arc<Notify>,
        attached: Arc<Mutex<Attached>>,
    ) -> LineService {
        let (clients, hosts, line) = Default::default();
        let (port, reopen) = (None, (Instant::ORIGIN, REOPEN_FIRST));
        let unsent = (Vec::new(), Instant::ORIGIN);
        LineService { medium, changed, attached, clients, hosts, line, port, unsent, reopen }
    }

    async fn run(mut self) {
        let mut buffer = [0; FRAME_MAX];
        while self.update() {
            let now = platform::now();
            if self.port.is_none() && now >= self.reopen.0 {
                self.open(now).await;
            }
            if let Err(error) = self.serve() {
                self.close(&error);
            }
            let due = match &self.port {
                None => self.reopen.0,
                Some(_) if !self.unsent.0.is_empty() => now + WRITE_MAX,
                Some(_) => self
                    .line
                    .poll_timeout(&self.hosts)
                    .map_or(now + LOOK, |due| Instant::ORIGIN + due),
            };
            let due = platform::timer_at(due.min(platform::now() + LOOK));
            let exchanged = async {
                match &mut self.port {
                    Some(port) => port.exchange(&mut self.unsent.0, &mut buffer).await,
                    None => pending().await,
                }
            };
            let received = tokio::select! {
                received = exchanged => received,
                () = self.changed.notified() => Ok(0),
                () = sleep_until(due) => Ok(0),
            };
            match received {
                Ok(count) => self.take(&buffer[..count]),
                Err(error) => self.close(&error),
            }
        }
        drop(self);
        actix_rt::Arbiter::current().stop();
    }

    /// Takes in new proxies and leaves out those that have gone, or hang. Returns whether the line
    /// is wanted.
    fn update(&mut self) -> bool {
        let now = platform::now();
        let mut attached = lock(&self.attached);
        for link in &attached.links {
            if link.unserved_for(now) > link.config.deadman {
                warn!("the proxy of a device has hung: the device is left to its dead-man");
                link.release();
            }
        }
        attached.links.retain(|link| link.status.borrow().phase != DevicePhase::Released);
        let stays = |link: &Arc<DeviceLink>| attached.links.iter().any(|it| Arc::ptr_eq(it, link));
        for at in (0..self.clients.len()).rev() {
            if !stays(&self.clients[at].link) {
                self.clients.remove(at);
                self.hosts.remove(at);
            }
        }
        for link in &attached.links[self.clients.len()..] {
            self.hosts.push(Host::new(link.config.clone(), since(now)));
            let (in_flight, unsent, values) = Default::default();
            let link = link.clone();
            self.clients.push(Client { link, in_flight, unsent, values, greeted: false });
        }
        !attached.ended
    }

    async fn open(&mut self, now: Instant) {
        match self.medium.open().await {
            Ok(port) => {
                self.port = Some(port);
                self.unsent.0.clear();
                self.line = HostLine::default();
                self.each_absent("it does not answer");
            }
            Err(error) => {
                self.reopen_later(now);
                self.each_absent(&error.to_string());
            }
        }
    }

    fn reopen_later(&mut self, now: Instant) {
        self.reopen = (now + self.reopen.1, (self.reopen.1 * 2).min(REOPEN_MAX));
    }

    fn each_absent(&self, why: &str) {
        let absent = DevicePhase::Absent(why.to_owned());
        self.clients.iter().for_each(|client| client.link.set_phase(absent.clone()));
    }

    fn close(&mut self, error: &io::Error) {
        debug!("the line of devices is closed: {error}");
        self.port = None;
        self.reopen_later(platform::now());
        self.lose_all(&error.to_string());
    }

    fn lose_all(&mut self, why: &str) {
        self.hosts.iter_mut().for_each(Host::handle_line_closed);
        self.take_events();
        self.each_absent(why);
    }

    fn take(&mut self, mut bytes: &[u8]) {
        if !bytes.is_empty() {
            self.reopen.1 = REOPEN_FIRST;
        }
        while !bytes.is_empty() {
            self.line.handle_bytes(&mut self.hosts, &mut bytes, since(platform::now()));
            self.take_events();
        }
    }

    /// Does what is due, and puts the next frame there if the one before is sent.
    fn serve(&mut self) -> io::Result<()> {
        if self.port.is_none() {
            self.refuse_orders();
            return Ok(());
        }
        let now = platform::now();
        self.line.handle_timeout(&mut self.hosts, since(now));
        self.take_events();
        if !self.unsent.0.is_empty() {
            let frame = self.medium.byte_time() * FRAME_MAX as u32;
            match now - self.unsent.1 {
                stuck if stuck > WRITE_END => {
                    return Err(io::Error::new(io::ErrorKind::TimedOut, PORT_FULL));
                }
                stuck if stuck > frame + WRITE_MAX => self.lose_all(PORT_FULL),
                _ => {}
            }
        }
        self.refuse_orders();
        self.give_orders();
        let (mut frame, clients) = ([0; FRAME_MAX], &self.clients);
        let value = |client: usize, port: usize, value: &mut [u8]| {
            // A value is announced after it was put there, and stays.
            if let Some(newest) = clients[client].values.get(&port) {
                value.copy_from_slice(newest);
            }
        };
        if self.unsent.0.is_empty()
            && let Some(frame) =
                self.line.poll_frame(&mut self.hosts, since(now), value, &mut frame)
        {
            self.unsent = (frame.to_vec(), now);
        }
        Ok(())
    }

    /// Commands to a device that does not serve end at once.
    fn refuse_orders(&mut self) {
        for client in &self.clients {
            while client.link.status.borrow().phase != DevicePhase::Serving
                && let Some((_, give)) = client.link.next_order()
            {
                let _ = give.send((CommandOutcome::NotSent, Vec::new()));
            }
        }
    }

    fn give_orders(&mut self) {
        for (client, host) in self.clients.iter_mut().zip(&mut self.hosts) {
            for (port, value) in client.link.take_values() {
                client.values.insert(port, value);
                // One that is lost to a device that does not serve would be stale after it.
                let _ = host.handle_publish(port);
            }
            if client.in_flight.is_some() || !host.is_serving() {
                continue;
            }
            if let Some((object, code)) = client.unsent.take() {
                let asked = host.handle_command(DeviceCommand::Text(object, code));
                client.in_flight = asked.is_ok().then_some(InFlight::Text(object, code));
            } else if let Some(pending) = client.link.next_order() {
                client.begin(host, pending);
            }
        }
    }

    fn take_events(&mut self) {
        while let Some((at, event)) = self.line.poll_event(&mut self.hosts) {
            self.clients[at].handle_event(event, &self.hosts[at]);
        }
    }
}

impl Client {
    fn begin(&mut self, host: &mut Host<Vec<Port>>, pending: PendingOrder) {
        let (order, give) = pending;
        match order.give(host) {
            Ok(()) => self.in_flight = Some(InFlight::Order(give)),
            Err(CommandError::Busy | CommandError::NotServing) => {
                self.link.put_back((order, give));
            }
            // The proxy's ports are those of the host, and packed values have their sizes.
            Err(_) => drop(give.send((CommandOutcome::NotSent, Vec::new()))),
        }
    }

    fn handle_event(&mut self, event: HostEvent, host: &Host<Vec<Port>>) {
        match event {
            HostEvent::Greeted(identity) => {
                if self.greeted && identity.reset {
                    let why = format!("{:?}, boot {}", identity.cause, identity.boot);
                    self.link.status.send_modify(|status| {
                        status.resets = (status.resets.0 + 1, why);
                    });
                }
                self.greeted = true;
                if identity.deadman && self.link.is_active() {
                    self.unsent = Some((1, message::CODE_DEADMAN));
                }
            }
            HostEvent::Serving => {
                self.link.set_phase(DevicePhase::Serving);
                let objects = self.link.config.ports.iter().map(Port::object).max().unwrap_or(1);
                let in_error = |object: &u8| host.state(*object) == Some(DeviceState::Error);
                if self.link.is_active() && self.unsent.is_none() {
                    self.unsent = (1..=objects).find(in_error).map(|object| (object, 0));
                }
            }
            HostEvent::Refused(mismatch) => {
                self.link.set_phase(DevicePhase::Refused(mismatch));
            }
            HostEvent::Lost => {
                let why = "it does not answer: it is hung, switched off or unplugged";
                self.link.set_phase(DevicePhase::Absent(why.to_owned()));
            }
            HostEvent::Done(outcome) => match self.in_flight.take() {
                Some(InFlight::Order(give)) => {
                    let _ = give.send((outcome, host.payload().to_vec()));
                }
                Some(InFlight::Text(object, code)) => {
                    let text = match outcome {
                        CommandOutcome::Replied(_) => String::from_utf8_lossy(host.payload()),
                        _ => "".into(),
                    };
                    self.link.set_fault(fault_text(object, code, &text));
                }
                None => {}
            },
            HostEvent::State { object, state: DeviceState::Error, code } => {
                self.unsent.get_or_insert((object, code));
            }
            HostEvent::State { .. } => {}
            HostEvent::Data { port } => {
                if let Some(receive) = &self.link.receivers[port] {
                    receive(host.payload());
                }
            }
            HostEvent::OutOfStep => warn!("a device was out of step: its line damages packets"),
        }
    }
}

fn fault_text(object: u8, code: u8, text: &str) -> String {
    let text = match (code, text) {
        (message::CODE_DEADMAN, "") => "dead-man: this node was silent",
        (message::CODE_INPUT_TOO_OLD, "") => "the newest value of an in port is too old",
        (_, "") => "the firmware gives no text",
        (_, text) => text,
    };
    format!("object {object} of the device is in error, code {code}: {text}")
}

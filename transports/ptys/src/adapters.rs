//! CAN adapters on ptys, and the bus between them: what one says, all others that are open hear.

use blastema_core::medium::can::slcan::{AdapterCommand, AdapterReply, LineEnd, LineSplitter};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags};
use rustix::pipe::{PipeFlags, pipe_with};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use tempfile::TempDir;

/// How much an adapter holds for a program that does not read, in bytes: the longest message of the
/// suite, so that a test which gets no time for a while loses nothing.
const MEMORY: usize = 512 * 1024;

/// Adapters from this number on answer no commands, as many do.
const MUTE: u8 = 100;

/// A bus with adapters that can be unplugged and plugged in again. Those from number 100 on answer
/// no commands, as many do not.
///
/// All of its methods panic where the system has no ptys.
pub struct Adapters {
    folder: TempDir,
    orders: SyncSender<Order>,
    /// The thread looks for orders when a byte comes here, and ends when it is closed.
    wake: Option<OwnedFd>,
    bus: Option<JoinHandle<()>>,
}

enum Order {
    Plug { at: PathBuf, mute: bool },
    Unplug { at: PathBuf },
    Inject { at: PathBuf, bytes: Vec<u8> },
}

struct Adapter {
    at: PathBuf,
    master: OwnedFd,
    /// Kept open, so that the port lives on when a program closes it.
    _slave: OwnedFd,
    lines: LineSplitter,
    is_open: bool,
    /// It answers no commands.
    mute: bool,
    waiting: Vec<u8>,
}

impl Default for Adapters {
    fn default() -> Self {
        let folder = TempDir::new().expect("a folder for the ports");
        let (orders, taken) = sync_channel(64);
        let (woken, wake) = pipe_with(PipeFlags::CLOEXEC).expect("a pipe");
        rustix::io::ioctl_fionbio(&woken, true).expect("a pipe");
        let bus = std::thread::spawn(move || run(&taken, &woken));
        Adapters { folder, orders, wake: Some(wake), bus: Some(bus) }
    }
}

impl Adapters {
    /// A bus without nodes.
    pub fn new() -> Self {
        Adapters::default()
    }

    /// The port of the adapter with this number.
    pub fn port(&self, number: u8) -> PathBuf {
        self.folder.path().join(number.to_string())
    }

    /// Plugs in the adapter with this number; it is there when this returns.
    pub fn plug(&self, number: u8) {
        self.order(Order::Plug { at: self.port(number), mute: number >= MUTE });
        while !self.port(number).exists() {
            std::thread::yield_now();
        }
    }

    /// Unplugs it; its port is gone when this returns.
    pub fn unplug(&self, number: u8) {
        self.order(Order::Unplug { at: self.port(number) });
        while self.port(number).exists() {
            std::thread::yield_now();
        }
    }

    /// Lets the adapter say these bytes to its program.
    pub fn inject(&self, number: u8, bytes: &[u8]) {
        self.order(Order::Inject { at: self.port(number), bytes: bytes.to_vec() });
    }

    fn order(&self, order: Order) {
        self.orders.send(order).expect("the bus runs");
        let wake = self.wake.as_ref().expect("open while we are");
        rustix::io::write(wake, b"!").expect("the bus runs");
    }
}

impl Drop for Adapters {
    fn drop(&mut self) {
        for number in 0..=u8::MAX {
            if self.port(number).is_symlink() {
                self.unplug(number);
            }
        }
        self.wake = None;
        if let Some(bus) = self.bus.take() {
            bus.join().expect("a bus ends in order");
        }
    }
}

impl Adapter {
    fn new(at: &Path, mute: bool) -> Self {
        let master =
            openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("a pty");
        grantpt(&master).expect("ours");
        unlockpt(&master).expect("ours");
        let name = ptsname(&master, Vec::new()).expect("it has a name");
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let slave = rustix::fs::open(&name, flags, Mode::empty()).expect("it is there");
        let mut settings = tcgetattr(&slave).expect("a terminal");
        settings.make_raw();
        tcsetattr(&slave, OptionalActions::Now, &settings).expect("a terminal");
        rustix::io::ioctl_fionbio(&master, true).expect("a file");
        symlink(name.to_str().expect("ASCII"), at).expect("no port is there");
        let (at, lines) = (at.to_owned(), LineSplitter::default());
        Adapter { at, master, _slave: slave, lines, is_open: false, mute, waiting: Vec::new() }
    }

    fn say(&mut self, reply: &AdapterReply) {
        // What there is no room for is lost, as in any adapter.
        if self.waiting.len() < MEMORY {
            reply.encode(&mut self.waiting);
        }
    }

    fn answer(&mut self, reply: &AdapterReply) {
        if !self.mute {
            self.say(reply);
        }
    }

    fn flush(&mut self) {
        if let Ok(written) = rustix::io::write(&self.master, &self.waiting) {
            self.waiting.drain(..written);
        }
    }

    /// Reads what the program says, and answers; the frames are for the bus.
    fn hear(&mut self) -> Vec<AdapterReply> {
        let mut buffer = [0; 4096];
        let Ok(read) = rustix::io::read(&self.master, &mut buffer) else { return Vec::new() };
        let mut frames = Vec::new();
        for byte in &buffer[..read] {
            let Some(LineEnd::Whole(line)) = self.lines.handle_byte(*byte) else { continue };
            match AdapterCommand::decode(&line) {
                Some(AdapterCommand::Send(frame)) if self.is_open => {
                    frames.push(AdapterReply::Frame(frame));
                    self.answer(&AdapterReply::Sent);
                }
                Some(AdapterCommand::Open) if !self.is_open => {
                    self.is_open = true;
                    self.answer(&AdapterReply::Done);
                }
                Some(AdapterCommand::Close) if self.is_open => {
                    self.is_open = false;
                    self.answer(&AdapterReply::Done);
                }
                Some(AdapterCommand::BitRate(_) | AdapterCommand::DataRate(_)) if !self.is_open => {
                    self.answer(&AdapterReply::Done)
                }
                _ => self.answer(&AdapterReply::Refused),
            }
        }
        frames
    }
}

/// The bus, until it is told to end.
fn run(orders: &Receiver<Order>, woken: &OwnedFd) {
    let mut adapters: Vec<Adapter> = Vec::new();
    loop {
        let wanted = |adapter: &Adapter| {
            let writes = !adapter.waiting.is_empty();
            PollFlags::IN | if writes { PollFlags::OUT } else { PollFlags::empty() }
        };
        let mut watched: Vec<_> = adapters
            .iter()
            .map(|adapter| PollFd::new(&adapter.master, wanted(adapter)))
            .chain([PollFd::new(woken, PollFlags::IN)])
            .collect();
        poll(&mut watched, None).expect("the files are open");
        if let Ok(0) = rustix::io::read(woken, &mut [0; 64]) {
            return;
        }
        while let Ok(order) = orders.try_recv() {
            carry_out(order, &mut adapters);
        }
        for speaker in 0..adapters.len() {
            for frame in adapters[speaker].hear() {
                for listener in (0..adapters.len()).filter(|number| *number != speaker) {
                    if adapters[listener].is_open {
                        adapters[listener].say(&frame);
                    }
                }
            }
        }
        adapters.iter_mut().for_each(Adapter::flush);
    }
}

fn carry_out(order: Order, adapters: &mut Vec<Adapter>) {
    match order {
        Order::Plug { at, mute } => adapters.push(Adapter::new(&at, mute)),
        Order::Unplug { at } => {
            adapters.retain(|adapter| adapter.at != at);
            std::fs::remove_file(at).expect("it was plugged in");
        }
        Order::Inject { at, bytes } => {
            let adapter = adapters.iter_mut().find(|adapter| adapter.at == at);
            adapter.expect("it is plugged in").waiting.extend(bytes);
        }
    }
}

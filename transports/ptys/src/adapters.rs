//! CAN adapters on ptys, and the bus between them: what one says, all others that are open hear.

use crate::cable::Pty;
use blastema_core::medium::can::slcan::{AdapterCommand, AdapterReply, LineEnd, LineSplitter};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::fd::OwnedFd;
use rustix::pipe::{PipeFlags, pipe_with};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard};
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
    plugged: AdapterList,
    /// The bus looks at its adapters when a byte comes here, and ends when it is closed.
    wake: Option<OwnedFd>,
    bus: Option<JoinHandle<()>>,
}

type AdapterList = Arc<Mutex<Vec<Adapter>>>;

struct Adapter {
    at: PathBuf,
    pty: Arc<Pty>,
    lines: LineSplitter,
    is_open: bool,
    /// It answers no commands.
    mute: bool,
    waiting: Vec<u8>,
}

impl Default for Adapters {
    fn default() -> Self {
        let folder = TempDir::new().expect("a folder for the ports");
        let (woken, wake) = pipe_with(PipeFlags::CLOEXEC).expect("a pipe");
        rustix::io::ioctl_fionbio(&woken, true).expect("a pipe");
        let plugged = AdapterList::default();
        let on_bus = plugged.clone();
        let bus = std::thread::spawn(move || run(&on_bus, &woken));
        Adapters { folder, plugged, wake: Some(wake), bus: Some(bus) }
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
        let at = self.port(number);
        let (pty, lines, waiting) = (Arc::new(Pty::open(&at)), LineSplitter::default(), Vec::new());
        let (is_open, mute) = (false, number >= MUTE);
        locked(&self.plugged).push(Adapter { at, pty, lines, is_open, mute, waiting });
        self.wake();
    }

    /// Unplugs it; its port is gone when this returns.
    pub fn unplug(&self, number: u8) {
        let at = self.port(number);
        locked(&self.plugged).retain(|adapter| adapter.at != at);
        std::fs::remove_file(at).expect("it was plugged in");
        self.wake();
    }

    /// Lets the adapter say these bytes to its program.
    pub fn inject(&self, number: u8, bytes: &[u8]) {
        self.change(number, |adapter| adapter.waiting.extend(bytes));
    }

    fn change(&self, number: u8, change: impl FnOnce(&mut Adapter)) {
        let at = self.port(number);
        let mut adapters = locked(&self.plugged);
        let adapter = adapters.iter_mut().find(|adapter| adapter.at == at);
        change(adapter.expect("it is plugged in"));
        drop(adapters);
        self.wake();
    }

    fn wake(&self) {
        let wake = self.wake.as_ref().expect("open while we are");
        rustix::io::write(wake, b"!").expect("the bus runs");
    }
}

fn locked(adapters: &AdapterList) -> MutexGuard<'_, Vec<Adapter>> {
    adapters.lock().expect("the bus runs")
}

impl Drop for Adapters {
    fn drop(&mut self) {
        self.wake = None;
        if let Some(bus) = self.bus.take() {
            bus.join().expect("a bus ends in order");
        }
    }
}

impl Adapter {
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
        if let Ok(written) = rustix::io::write(&self.pty.master, &self.waiting) {
            self.waiting.drain(..written);
        }
    }

    /// Reads what the program says, and answers; the frames are for the bus.
    fn hear(&mut self) -> Vec<AdapterReply> {
        let mut buffer = [0; 4096];
        let Ok(read) = rustix::io::read(&self.pty.master, &mut buffer) else { return Vec::new() };
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
fn run(plugged: &AdapterList, woken: &OwnedFd) {
    loop {
        let wanted = |adapter: &Adapter| {
            let writes = !adapter.waiting.is_empty();
            let flags = PollFlags::IN | if writes { PollFlags::OUT } else { PollFlags::empty() };
            (adapter.pty.clone(), flags)
        };
        let wanted: Vec<_> = locked(plugged).iter().map(wanted).collect();
        let mut watched: Vec<_> = wanted
            .iter()
            .map(|(pty, flags)| PollFd::new(&pty.master, *flags))
            .chain([PollFd::new(woken, PollFlags::IN)])
            .collect();
        poll(&mut watched, None).expect("the files are open");
        if let Ok(0) = rustix::io::read(woken, &mut [0; 64]) {
            return;
        }
        let mut adapters = locked(plugged);
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

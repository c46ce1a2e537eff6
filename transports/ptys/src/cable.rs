//! A serial cable of two ptys, each at a stable path, with a relay between them.

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags};
use rustix::pipe::{PipeFlags, pipe_with};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Action, OptionalActions, tcflow, tcgetattr, tcsetattr};
use std::cell::RefCell;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;
use tempfile::TempDir;

/// Two ends, `left` and `right`, that can be unplugged and plugged in again. Where they are opened
/// with different speeds, neither understands the other.
///
/// ```
/// let cable = blastema_ptys::Cable::new();
/// assert!(cable.left().exists());
/// cable.unplug();
/// assert!(!cable.left().exists());
/// ```
///
/// All of its methods panic where the system has no ptys.
pub struct Cable {
    folder: TempDir,
    /// So many bytes are moved each way in a tick; all that there are where it is not given.
    tick: Option<usize>,
    /// One of so many bits is turned on the way.
    noise: Option<u64>,
    plugged: RefCell<Option<Plugged>>,
}

struct Plugged {
    ends: Arc<[Pty; 2]>,
    /// The relay ends when this is closed.
    stop: OwnedFd,
    relay: JoinHandle<()>,
}

/// The far side of one end.
pub(crate) struct Pty {
    pub(crate) master: OwnedFd,
    /// Kept open, so that the line lives on when a program closes its end, as a cable does.
    slave: OwnedFd,
}

impl Default for Cable {
    fn default() -> Self {
        let folder = TempDir::new().expect("a folder for the ends");
        let cable = Cable { folder, tick: None, noise: None, plugged: RefCell::default() };
        cable.plug();
        cable
    }
}

/// How often a slow cable moves something. On a busy computer it does so more rarely, and is
/// slower.
const TICK: Timespec = Timespec { tv_sec: 0, tv_nsec: 10_000_000 };

impl Cable {
    /// A cable that is plugged in.
    pub fn new() -> Self {
        Cable::default()
    }

    /// A cable that carries so many bytes a second each way, or a little less: what it is given
    /// beyond waits in the system, as it does before a real port.
    pub fn slow(bytes_per_second: usize) -> Self {
        let mut cable = Cable::default();
        cable.unplug();
        cable.tick = Some((bytes_per_second / 100).max(1));
        cable.plug();
        cable
    }

    /// A cable on which one of so many bits is turned, the same ones in each run.
    pub fn noisy(bits: u64) -> Self {
        let mut cable = Cable::default();
        cable.unplug();
        cable.noise = Some(bits);
        cable.plug();
        cable
    }

    /// Holds back what is written at the left end, or lets it pass, as handshake lines do.
    pub fn hold_left(&self, held: bool) {
        let plugged = self.plugged.borrow();
        let Plugged { ends, .. } = plugged.as_ref().expect("it is plugged in");
        let action = if held { Action::OOff } else { Action::OOn };
        tcflow(&ends[0].slave, action).expect("a terminal");
    }

    /// The path of one end.
    pub fn left(&self) -> PathBuf {
        self.folder.path().join("left")
    }

    /// The path of the other end.
    pub fn right(&self) -> PathBuf {
        self.folder.path().join("right")
    }

    /// Both ends appear at their paths.
    pub fn plug(&self) {
        let ends = Arc::new([Pty::open(&self.left()), Pty::open(&self.right())]);
        let (stopped, stop) = pipe_with(PipeFlags::CLOEXEC).expect("a pipe");
        let (between, tick, noise) = (ends.clone(), self.tick, self.noise);
        let relay = std::thread::Builder::new()
            .name("cable".to_owned())
            .spawn(move || relay(&between, &stopped, tick, noise))
            .expect("the system has a thread");
        *self.plugged.borrow_mut() = Some(Plugged { ends, stop, relay });
    }

    /// Both ends vanish, and their devices with them, as USB adapters do.
    pub fn unplug(&self) {
        let Some(Plugged { stop, relay, ends }) = self.plugged.borrow_mut().take() else { return };
        for end in [self.left(), self.right()] {
            std::fs::remove_file(end).expect("it was plugged in");
        }
        drop((stop, ends));
        relay.join().expect("a relay ends in order");
    }

    /// Puts bytes onto the line towards the left or the right end.
    pub fn inject(&self, towards: &Path, bytes: &[u8]) {
        let plugged = self.plugged.borrow();
        let Plugged { ends, .. } = plugged.as_ref().expect("it is plugged in");
        let end = if towards == self.left() { &ends[0] } else { &ends[1] };
        // What the line has no room for is lost, as noise may be.
        let _ = rustix::io::write(&end.master, bytes);
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.unplug();
    }
}

impl Pty {
    pub(crate) fn open(at: &Path) -> Self {
        let master =
            openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("a pty");
        grantpt(&master).expect("ours");
        unlockpt(&master).expect("ours");
        let name = ptsname(&master, Vec::new()).expect("it has a name");
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let slave = rustix::fs::open(&name, flags, Mode::empty()).expect("it is there");
        let mut settings = tcgetattr(&slave).expect("a terminal");
        // Nothing is echoed or changed before a program opens it.
        settings.make_raw();
        tcsetattr(&slave, OptionalActions::Now, &settings).expect("a terminal");
        rustix::io::ioctl_fionbio(&master, true).expect("a file");
        symlink(name.to_str().expect("ASCII"), at).expect("no port is there");
        Pty { master, slave }
    }

    fn speed(&self) -> u32 {
        tcgetattr(&self.slave).expect("a terminal").output_speed()
    }
}

/// Moves bytes both ways until it is stopped; what one end does not take waits.
fn relay(ends: &[Pty; 2], stopped: &OwnedFd, tick: Option<usize>, noise: Option<u64>) {
    let mut random: u64 = 0x9e37_79b9;
    let mut waiting: [Vec<u8>; 2] = Default::default();
    loop {
        if tick.is_some() {
            let mut stop = [PollFd::new(stopped, PollFlags::empty())];
            poll(&mut stop, Some(&TICK)).expect("the files are open");
        }
        let wanted = |to: usize| {
            // From an end whose bytes still wait nothing is read.
            let reads = if waiting[1 - to].is_empty() { PollFlags::IN } else { PollFlags::empty() };
            let writes = if waiting[to].is_empty() { PollFlags::empty() } else { PollFlags::OUT };
            reads | writes
        };
        let mut watched = [
            PollFd::new(&ends[0].master, wanted(0)),
            PollFd::new(&ends[1].master, wanted(1)),
            PollFd::new(stopped, PollFlags::empty()),
        ];
        poll(&mut watched, None).expect("the files are open");
        if !watched[2].revents().is_empty() {
            return;
        }
        let mismatched = ends[0].speed() != ends[1].speed();
        for (from, to) in [(0, 1), (1, 0)] {
            let mut buffer = [0; 4096];
            let buffer = &mut buffer[..tick.unwrap_or(4096)];
            if waiting[to].is_empty()
                && let Ok(read) = rustix::io::read(&ends[from].master, &mut *buffer)
            {
                let bytes = &mut buffer[..read];
                if mismatched {
                    // Bits are sampled at wrong moments: neither end understands the other.
                    bytes.iter_mut().enumerate().for_each(|(n, byte)| {
                        *byte = byte.rotate_left(n as u32 % 7 + 1) ^ 0x55;
                    });
                }
                if let Some(bits) = noise {
                    for bit in 0..8 * bytes.len() {
                        // Xorshift: Marsaglia, Journal of Statistical Software 8 (2003).
                        random ^= random << 13;
                        random ^= random >> 7;
                        random ^= random << 17;
                        if random.is_multiple_of(bits) {
                            bytes[bit / 8] ^= 1 << (bit % 8);
                        }
                    }
                }
                waiting[to].extend_from_slice(bytes);
            }
            if let Ok(written) = rustix::io::write(&ends[to].master, &waiting[to]) {
                waiting[to].drain(..written);
            }
        }
    }
}

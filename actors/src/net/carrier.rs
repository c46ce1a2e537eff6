//! Whether the interfaces that links use have a carrier, looked at from a thread of its own.
//!
//! A link's hellos find every fault, a few intervals after it. A pulled cable the interface itself
//! knows of at once, and this is how the links learn it: an accelerator, never the judge. Only the
//! *loss* of a carrier that was there says anything; whether a link carries again, hellos prove.
//!
//! Linux tells of a change by netlink at once if it has told of no other within the last second,
//! and else up to a second late (`net/core/link_watch.c`): a second cable that is cut, or one that
//! flaps, is such a change. `/sys/class/net/…/carrier` is brought up to date when it is read, as
//! `ETHTOOL_GLINK` is. So netlink only wakes this thread, which reads there; it also does so every
//! few milliseconds by itself.
//!
//! Where there is no such file, on another system or in a container, nothing is watched.

use crate::platform;
use actix::Recipient;
use blastema_contract::link::CarrierChanged;
use std::fs::File;
use std::io;
use std::net::IpAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::thread::JoinHandle;
use std::time::Duration;
use tracing::{debug, info};

/// How often interfaces are looked at. A look is one system call for each, and one to wait. Each
/// takes the kernel's lock on all interfaces for a moment (`carrier_show`), which is why it is not
/// oftener.
const POLL_INTERVAL: Duration = Duration::from_millis(2);
/// After so many looks, an interface that was not found is sought again: it may be plugged in
/// later.
const SEEK: u32 = 500;
/// Where Linux tells of interfaces.
const INTERFACES: &str = "/sys/class/net";

/// Which interface a network uses.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Interface {
    /// The one that is called so.
    Named(String),
    /// The one that has this address.
    With(IpAddr),
}

impl Interface {
    /// The interface of a socket that is bound to this address, where that says which.
    pub(crate) fn of(address: IpAddr) -> Option<Interface> {
        let one = !address.is_unspecified() && !address.is_loopback() && !address.is_multicast();
        one.then_some(Interface::With(address))
    }

    /// Whether the system says that it is wireless.
    pub(crate) fn is_wireless(&self) -> bool {
        self.is_wireless_in(Path::new(INTERFACES))
    }

    fn is_wireless_in(&self, interfaces: &Path) -> bool {
        self.name().is_some_and(|name| interfaces.join(name).join("wireless").exists())
    }

    fn name(&self) -> Option<String> {
        match self {
            // No path, whatever the user wrote.
            Interface::Named(name) => {
                let path = name.is_empty() || name.starts_with('.') || name.contains('/');
                (!path).then(|| name.clone())
            }
            Interface::With(address) => {
                let all = if_addrs::get_if_addrs().unwrap_or_default();
                let own = all.into_iter().find(|interface| interface.ip() == *address);
                own.map(|interface| interface.name)
            }
        }
    }
}

/// An interface, and who is to know of its carrier.
pub(crate) struct MonitoredInterface {
    pub(crate) interface: Interface,
    pub(crate) recipient: Recipient<CarrierChanged>,
}

/// Ends the watch when dropped, or told to.
pub(crate) struct CarrierMonitor {
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl CarrierMonitor {
    /// Watches these interfaces; without any, no thread is started.
    pub(crate) fn start(watched: Vec<MonitoredInterface>) -> CarrierMonitor {
        let ended = Arc::new(AtomicBool::new(false));
        if watched.is_empty() {
            return CarrierMonitor { ended, thread: None };
        }
        let mut eyes: Vec<Eye> = watched.into_iter().map(Eye::new).collect();
        let stop = ended.clone();
        let watch = move || {
            let news = News::open();
            let mut looks = 0;
            while !stop.load(Relaxed) {
                let seek = looks % SEEK == 0;
                eyes.iter_mut().for_each(|eye| eye.look(Path::new(INTERFACES), seek));
                looks = looks.wrapping_add(1);
                news.wait();
            }
        };
        // Without the thread, hellos find a pulled cable as they find everything else.
        let thread = platform::start_thread("carrier", watch).ok();
        CarrierMonitor { ended, thread }
    }

    /// Ends it with the present look.
    pub(crate) fn end(&self) {
        self.ended.store(true, Relaxed);
    }
}

impl Drop for CarrierMonitor {
    fn drop(&mut self) {
        self.end();
        if let Some(thread) = self.thread.take() {
            // The thread never blocks for longer than one look.
            let _ = thread.join();
        }
    }
}

/// What is known of one interface.
struct Eye {
    watched: MonitoredInterface,
    name: Option<String>,
    /// Says how it is whenever it is read from its beginning, and nothing any more once the
    /// interface was taken out, also if another of that name is there.
    file: Option<File>,
    /// Whether it has its carrier; `None` while it was never seen to have one.
    present: Option<bool>,
}

impl Eye {
    fn new(watched: MonitoredInterface) -> Self {
        Eye { watched, name: None, file: None, present: None }
    }

    fn look(&mut self, interfaces: &Path, seek: bool) {
        // One that has lost its carrier may have been replaced by another with the same address.
        if seek && self.present != Some(true) {
            let name = self.watched.interface.name();
            self.file.take_if(|_| name != self.name);
            self.name = name;
        }
        let Some(name) = &self.name else { return };
        if self.file.is_none() {
            self.file = File::open(interfaces.join(name).join("carrier")).ok();
        }
        // An interface that is switched off cannot be read.
        let first = self.file.as_ref().and_then(read_anew);
        self.file.take_if(|_| first.is_none());
        let present = first == Some(b'1');
        match (self.present, present) {
            (None | Some(false), true) => info!(interface = %name, "has its carrier"),
            (Some(true), false) => info!(interface = %name, "has lost its carrier"),
            _ => return,
        }
        if self.present.replace(present).is_some() {
            self.watched.recipient.do_send(CarrierChanged { present });
        }
    }
}

/// The first letter of a file as it is now.
#[cfg(unix)]
fn read_anew(file: &File) -> Option<u8> {
    let mut first = [0];
    let length = std::os::unix::fs::FileExt::read_at(file, &mut first, 0).ok()?;
    (length == 1).then_some(first[0])
}

#[cfg(not(unix))]
fn read_anew(_: &File) -> Option<u8> {
    None
}

/// What wakes the thread before its time.
struct News(Option<Socket>);

#[cfg(target_os = "linux")]
type Socket = std::os::fd::OwnedFd;
#[cfg(not(target_os = "linux"))]
type Socket = std::convert::Infallible;

impl News {
    fn open() -> News {
        News(open().inspect_err(|error| debug!(%error, "no news of interfaces")).ok())
    }

    /// Waits until something has happened to some interface, but no longer than till the next look.
    fn wait(&self) {
        match &self.0 {
            Some(socket) => wait(socket),
            None => platform::wait(POLL_INTERVAL),
        }
    }
}

#[cfg(target_os = "linux")]
fn open() -> io::Result<Socket> {
    use rustix::net::netlink::SocketAddrNetlink;
    use rustix::net::{AddressFamily, SocketFlags, SocketType};
    /// `RTMGRP_LINK` of `linux/rtnetlink.h`.
    const LINKS: u32 = 1;
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    // Protocol 0 is NETLINK_ROUTE.
    let (family, kind) = (AddressFamily::NETLINK, SocketType::RAW);
    let socket = rustix::net::socket_with(family, kind, flags, None)?;
    rustix::net::bind(&socket, &SocketAddrNetlink::new(0, LINKS))?;
    Ok(socket)
}

#[cfg(target_os = "linux")]
fn wait(socket: &Socket) {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    /// So many messages are thrown away before the next look; a storm must not keep it off.
    const AT_ONCE: usize = 64;
    let timeout = Timespec { tv_sec: 0, tv_nsec: POLL_INTERVAL.subsec_nanos().into() };
    let mut ready = [PollFd::new(socket, PollFlags::IN)];
    if poll(&mut ready, Some(&timeout)).is_ok_and(|ready| ready > 0) {
        // What has happened is not read here: the files say how it is now. A buffer that ran over
        // is an error once, and news as well.
        let mut thrown_away = [0u8; 8192];
        for _ in 0..AT_ONCE {
            if rustix::io::read(socket, &mut thrown_away[..]).is_err() {
                break;
            }
        }
    }
}

#[cfg(not(target_os = "linux"))]
fn open() -> io::Result<Socket> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(not(target_os = "linux"))]
fn wait(socket: &Socket) {
    match *socket {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_doubles::Probe;
    use std::fs;

    #[test]
    fn an_address_says_which_interface_only_where_it_is_one_of_a_network() {
        let of = |text: &str| Interface::of(text.parse().unwrap());
        assert!(of("192.168.0.1").is_some() && of("fd00::1").is_some());
        assert_eq!(
            [of("0.0.0.0"), of("127.0.0.1"), of("::1"), of("224.0.0.1")],
            [const { None }; 4]
        );
    }

    #[test]
    fn a_name_that_is_a_path_is_no_interface() {
        assert_eq!(Interface::Named("../../etc".into()).name(), None);
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn only_the_loss_of_a_carrier_that_was_there_and_its_return_are_told() {
        let interfaces = tempfile::tempdir().unwrap();
        let folder = interfaces.path().join("eth7");
        fs::create_dir(&folder).unwrap();
        let probe = Probe::<CarrierChanged>::start();
        let interface = Interface::Named("eth7".into());
        let mut eye = Eye::new(MonitoredInterface { interface, recipient: probe.recipient() });
        let mut reads = |text: Option<&str>| {
            fs::write(folder.join("carrier"), text.unwrap_or_default()).unwrap();
            eye.look(interfaces.path(), true);
            if text.is_none() {
                // It cannot be read any more, and then another one is in its place.
                fs::remove_file(folder.join("carrier")).unwrap();
            }
        };

        reads(Some("0\n"));
        reads(Some("1\n"));
        reads(Some("1\n"));
        reads(None);
        reads(Some("0\n"));
        reads(Some("1\n"));

        let reports: Vec<_> = [probe.expect().await, probe.expect().await].into();
        assert_eq!(reports, [false, true].map(|present| CarrierChanged { present }));
    }
}

//! Ends that are connected by a router of Zenoh, in this process and on loopback.

use super::*;
use blastema_transports::FrameTransport;
use blastema_zenoh::ZenohNetwork;
use std::net::TcpListener;
use tokio::runtime::Runtime;
use zenoh::{Config, Session, Wait};

pub(crate) struct OverZenoh {
    at: String,
    ends: Cell<u32>,
    /// Says what no transport would.
    stranger: Option<Session>,
    router: Option<Session>,
}

/// Zenoh does not run on the runtime of the test.
fn session(settings: &[(&str, String)]) -> Session {
    let mut config = Config::default();
    for (key, value) in settings {
        config.insert_json5(key, value).unwrap();
    }
    let open = move || {
        let runtime = Runtime::new().unwrap();
        let session = runtime.block_on(async { zenoh::open(config).await.unwrap() });
        runtime.shutdown_background();
        session
    };
    std::thread::spawn(open).join().unwrap()
}

impl Default for OverZenoh {
    fn default() -> Self {
        let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let at = format!("tcp/{free}");
        let endpoints = format!("[{at:?}]");
        let no = || "false".to_owned();
        let router = session(&[
            ("mode", r#""router""#.to_owned()),
            ("listen/endpoints", endpoints.clone()),
            ("scouting/multicast/enabled", no()),
        ]);
        let stranger = session(&[
            ("mode", r#""client""#.to_owned()),
            ("connect/endpoints", endpoints),
            ("scouting/multicast/enabled", no()),
        ]);
        let (router, stranger) = (Some(router), Some(stranger));
        OverZenoh { at, ends: Cell::new(0), stranger, router }
    }
}

impl Drop for OverZenoh {
    fn drop(&mut self) {
        let sessions = [self.stranger.take(), self.router.take()];
        let close =
            move || sessions.into_iter().flatten().for_each(|one| one.close().wait().unwrap());
        std::thread::spawn(close).join().unwrap();
    }
}

impl Medium for OverZenoh {
    // Before the receiver, and in the medium.
    const HELD: u64 = 256 + 1024;
    // Some wait for the thread of Zenoh.
    const KEEPS: bool = true;

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let name = match at {
            Some(MediumAddress::Own(name)) => name.to_string(),
            _ => {
                self.ends.set(self.ends.get() + 1);
                format!("end{}", self.ends.get())
            }
        };
        let network = ZenohNetwork::new("fleet/ranger", &name).connect(&self.at);
        Opened::of(FrameTransport::new(network))
    }

    fn garbage(&self, to: &MediumAddress) {
        let stranger = self.stranger.clone().unwrap();
        let to = to.to_string();
        let put = move || {
            for (key, length) in [("x", 0), ("x", 7), ("x y", 7), ("\u{e4}", 7), ("x", 1 << 20)] {
                let key = format!("fleet/ranger/{to}/{key}");
                stranger.put(key, vec![0xA5; length]).wait().unwrap();
            }
        };
        std::thread::spawn(put).join().unwrap();
    }
}

conformance! { shared: over_routers: OverZenoh }

//! What needs a kernel with CAN and USB: run by `tests/guest/run`, in a virtual machine.
//!
//! The guest has `vcan0`, two CAN controllers on one bus (`can0`, `can1`), the kernel's ISO-TP, a
//! USB serial device with both of its ends (`ttyACM0`, `ttyGS0`), and a cable between the serial
//! ports `ttyS1` and `ttyS2`.
use actix::Actor;
use blastema_contract::transport::{
    Attach, MediumAddress, Received, Transmit, Transport, TransportReport,
};
use blastema_core::medium::can::isotp::SeparationTime;
use blastema_core::medium::can::slcan::{
    AdapterCommand as Line, AdapterReply, BitRate, LineSplitter,
};
use blastema_core::medium::can::{
    BusAddress, CanFrame, CanId, Format, IsoTp, IsoTpConfig, IsoTpOutput, slcan,
};
use blastema_core::medium::lane::FrameLane;
use blastema_core::{Instant, Machine};
use blastema_doubles::{Probe, now};
use blastema_transports::{
    CanBus, CanConfig, FrameMedium, FrameTransport, Rs485, SerialConfig, SerialLine,
};
use bytes::Bytes;
use socketcan::id::FdFlags;
use socketcan::{
    CanAnyFrame, CanDataFrame, CanFdFrame, CanFdSocket, EmbeddedFrame, ExtendedId, Frame, Socket,
};
use std::io::{Read, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// How long anything may take here: the guest's processor is a program.
const PATIENCE: Duration = Duration::from_secs(60);

struct End {
    transport: Transport,
    frames: Probe<Received>,
    reports: Probe<TransportReport>,
}

impl End {
    fn new(medium: impl FrameMedium) -> Self {
        let transport = Transport::from(FrameTransport::new(medium).start());
        let (frames, reports) = (Probe::start(), Probe::start());
        let (to_frames, to_reports) = (frames.recipient(), reports.recipient());
        transport.attach.do_send(Attach::new(to_frames, to_reports));
        End { transport, frames, reports }
    }

    fn can(interface: &str, address: u8) -> Self {
        let mut config = CanConfig::new(interface);
        config.node.address = address;
        End::new(CanBus::new(config, now))
    }

    async fn opened(&self) {
        self.reports.wait(|report| matches!(report, TransportReport::Opened { .. })).await;
    }

    async fn closed(&self) -> String {
        let closed = |report: &TransportReport| matches!(report, TransportReport::Closed { .. });
        match self.reports.wait(closed).await {
            TransportReport::Closed { reason } => reason,
            other => unreachable!("{other:?} was not waited for"),
        }
    }

    fn send(&self, to: MediumAddress, frame: Bytes) {
        self.transport.transmit.do_send(Transmit::new(to, frame.into()));
    }

    /// Sends both ways until that was received: what comes back may lose its first words.
    async fn speak_with(&self, other: &End, own: MediumAddress, theirs: MediumAddress) {
        for (from, to, address) in [(self, other, &theirs), (other, self, &own)] {
            let text = message(500);
            let heard = async {
                loop {
                    from.send(address.clone(), text.clone());
                    let once = tokio::time::timeout(Duration::from_secs(1), to.frames.expect());
                    if once.await.is_ok_and(|received| received.frame == text) {
                        return;
                    }
                }
            };
            tokio::time::timeout(PATIENCE, heard).await.expect("they hear each other");
        }
    }
}

fn message(length: usize) -> Bytes {
    (0..length).map(|at| (at % 251) as u8).collect()
}

/// Programs by their path: the guest's shell has some of the same name that know less.
fn sh(command: &str) {
    let status = Command::new("sh").args(["-c", command]).status().unwrap();
    assert!(status.success(), "{command}");
}

/// Waits for what the kernel does in its own time.
async fn appears(path: &str) {
    let there = async {
        while !Path::new(path).exists() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(PATIENCE, there).await.expect(path);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn two_controllers_on_one_bus_hear_each_other_until_one_is_down_and_when_it_is_up_again() {
    let (a, b) = (End::can("can0", 1), End::can("can1", 2));
    a.opened().await;
    b.opened().await;
    let (at_a, at_b) = (MediumAddress::Can(1), MediumAddress::Can(2));
    a.speak_with(&b, at_a.clone(), at_b.clone()).await;

    sh("/sbin/ip link set can1 down");
    let reason = b.closed().await;
    assert!(reason.contains("ip link set can1 up"), "{reason}");
    sh("/sbin/ip link set can1 up type can bitrate 500000");
    b.opened().await;

    a.speak_with(&b, at_a, at_b).await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_controller_that_is_removed_is_used_again_when_it_is_back() {
    let (a, b) = (End::can("can0", 1), End::can("can1", 2));
    a.opened().await;
    b.opened().await;

    let device = std::fs::canonicalize("/sys/class/net/can1/device").unwrap();
    let device = device.file_name().unwrap().to_str().unwrap();
    sh(&format!("echo {device} > /sys/bus/pci/drivers/kvaser_pci/unbind"));
    let reason = b.closed().await;
    assert!(reason.contains("plug the adapter in") || reason.contains("is down"), "{reason}");
    sh(&format!("echo {device} > /sys/bus/pci/drivers/kvaser_pci/bind"));
    appears("/sys/class/net/can1").await;
    sh("/sbin/ip link set can1 up type can bitrate 500000");
    b.opened().await;

    a.speak_with(&b, MediumAddress::Can(1), MediumAddress::Can(2)).await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn an_interface_that_carries_no_fd_frames_is_refused_with_what_helps() {
    let mut config = CanConfig::new("can0");
    config.fd = true;
    let end = End::new(CanBus::new(config, now));

    let reason = end.closed().await;

    assert!(reason.contains("fd on"), "{reason}");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_controller_that_leaves_the_bus_is_closed_at_once_and_told_why() {
    sh("/sbin/ip link add vcan7 type vcan");
    sh("/sbin/ip link set vcan7 up");
    let end = End::can("vcan7", 1);
    end.opened().await;

    // What the kernel says of a controller that has had too many errors: no test makes those
    // here.
    let other = CanFdSocket::open("vcan7").unwrap();
    let word = [&0x2000_0040_u32.to_ne_bytes()[..], &[8, 0, 0, 0], &[0; 8]].concat();
    assert_eq!(rustix::io::write(&other, &word), Ok(16));

    let reason = end.closed().await;
    assert!(reason.contains("off the bus") && reason.contains("restart-ms"), "{reason}");
    end.opened().await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn an_interface_that_is_not_there_is_used_once_it_is() {
    let end = End::can("vcan9", 1);
    let reason = end.closed().await;
    assert!(reason.contains("no such interface"), "{reason}");

    sh("/sbin/ip link add vcan9 type vcan");
    let reason = end.closed().await;
    assert!(reason.contains("it is down"), "{reason}");
    sh("/sbin/ip link set vcan9 up");
    end.opened().await;
    sh("/sbin/ip link del vcan9");
    end.closed().await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_usb_device_without_a_line_is_not_held_to_the_speed_that_was_set() {
    appears("/dev/ttyACM0").await;
    appears("/dev/ttyGS0").await;
    let end = |path: &str| End::new(SerialLine::new(SerialConfig::new(path), now));
    let (host, device) = (end("/dev/ttyACM0"), end("/dev/ttyGS0"));
    host.opened().await;
    device.opened().await;
    host.speak_with(&device, MediumAddress::Line, MediumAddress::Line).await;

    let began = now();
    for _ in 0..100 {
        host.send(MediumAddress::Line, message(500));
        tokio::time::timeout(PATIENCE, device.frames.expect()).await.expect("it comes");
    }

    let line = SerialConfig::new("/dev/ttyACM0").time_of(100 * 500);
    assert!(now() - began < line / 2, "{:?}, where a line takes {line:?}", now() - began);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_driver_of_a_real_port_that_cannot_turn_rs485_says_so() {
    let mut config = SerialConfig::new("/dev/ttyS1");
    config.rs485 = Some(Rs485::default());
    let reason = End::new(SerialLine::new(config, now)).closed().await;
    assert!(reason.contains("does not turn the line"), "{reason}");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_usb_serial_device_that_is_unbound_is_opened_when_it_is_back() {
    let fast = |path: &str| {
        let mut config = SerialConfig::new(path);
        config.baud = Some(1_000_000);
        End::new(SerialLine::new(config, now))
    };
    appears("/dev/ttyACM0").await;
    appears("/dev/ttyGS0").await;
    let (host, device) = (fast("/dev/ttyACM0"), fast("/dev/ttyGS0"));
    host.opened().await;
    device.opened().await;
    let line = MediumAddress::Line;
    host.speak_with(&device, line.clone(), line.clone()).await;

    let port = std::fs::canonicalize("/sys/class/tty/ttyACM0/device").unwrap();
    let port = port.file_name().unwrap().to_str().unwrap();
    sh(&format!("echo {port} > /sys/bus/usb/drivers/cdc_acm/unbind"));
    let reason = host.closed().await;
    assert!(reason.contains("plug"), "{reason}");
    sh(&format!("echo {port} > /sys/bus/usb/drivers/cdc_acm/bind"));
    host.opened().await;

    host.speak_with(&device, line.clone(), line).await;
}

const FD: Format = Format::Fd { fast: false };

/// Our machine, as node 1, on a socket of its own.
struct Ours {
    machine: IsoTp,
    socket: CanFdSocket,
}

impl Ours {
    fn new(format: Format, block_size: u8, separation_ms: u64) -> Self {
        let mut config = IsoTpConfig::default();
        (config.format, config.block_size, config.message_max) = (format, block_size, 10_000);
        config.separation = SeparationTime::at_least(Duration::from_millis(separation_ms));
        let machine = IsoTp::new(BusAddress(1), config).unwrap();
        let socket = CanFdSocket::open("vcan0").unwrap();
        socket.set_read_timeout(Duration::from_millis(1)).unwrap();
        Ours { machine, socket }
    }

    /// Runs until the machine says something.
    fn run(&mut self) -> IsoTpOutput {
        let started = std::time::Instant::now();
        while started.elapsed() < PATIENCE {
            let now = Instant::from_nanos(1 + started.elapsed().as_nanos() as u64);
            if let Ok(frame) = self.socket.read_frame()
                && let Some(frame) = from_socket(&frame)
            {
                self.machine.handle_frame(&frame, now);
            }
            self.machine.handle_timeout(now);
            while let Some(frame) = self.machine.poll_frame(now) {
                self.write(&frame);
            }
            if let Some(output) = self.machine.poll_output() {
                return output;
            }
        }
        panic!("nothing came: {:?}", self.machine);
    }

    fn write(&self, frame: &CanFrame) {
        let id = ExtendedId::new(frame.id().number()).unwrap();
        let written = match frame.format() {
            Format::Classic => {
                self.socket.write_frame(&CanDataFrame::new(id, frame.data()).unwrap())
            }
            Format::Fd { .. } => {
                let flags = FdFlags::empty();
                let frame = CanFdFrame::with_flags(id, frame.data(), flags).unwrap();
                self.socket.write_frame(&frame)
            }
        };
        written.unwrap();
    }
}

fn from_socket(frame: &CanAnyFrame) -> Option<CanFrame> {
    let id = CanId::extended(frame.raw_id())?;
    match frame {
        CanAnyFrame::Normal(frame) => CanFrame::new(id, Format::Classic, frame.data()),
        CanAnyFrame::Fd(frame) => CanFrame::new(id, FD, frame.data()),
        _ => None,
    }
}

/// The kernel's ISO-TP as node 2, by one of can-utils' programs.
fn kernel(program: &str, options: &str) -> Child {
    Command::new(program)
        .args(["-s", "18DA0102", "-d", "18DA0201"])
        .args(options.split_whitespace())
        .arg("vcan0")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("can-utils are there")
}

/// Sockets of ISO-TP that wait, as the kernel lists them.
fn wait_for_listener() {
    let started = std::time::Instant::now();
    while started.elapsed() < PATIENCE {
        let list = std::fs::read_to_string("/proc/net/can/rcvlist_sff").unwrap_or_default()
            + &std::fs::read_to_string("/proc/net/can/rcvlist_eff").unwrap_or_default();
        if list.contains("98da0201") || list.contains("18da0201") {
            return;
        }
        std::thread::yield_now();
    }
    panic!("the kernel does not listen");
}

#[test]
fn the_kernels_iso_tp_understands_ours_and_ours_the_kernels() {
    let _turn = blastema_doubles::turn();
    // `wishes` are what the kernel asks of us as a sender.
    let check =
        |format: Format, wishes: &str, block_size: u8, separation_ms: u64, length: usize| {
            let options = if format == FD { "-L 72:64:0" } else { "" };
            let sent = message(length);
            let mut ours = Ours::new(format, block_size, separation_ms);
            // To the kernel.
            let mut receiver = kernel("isotprecv", &format!("{options} {wishes}"));
            wait_for_listener();
            let now = Instant::from_nanos(1);
            ours.machine
                .handle_message(BusAddress(2), sent.clone(), FrameLane::Usual, now)
                .unwrap();
            assert_eq!(ours.run(), IsoTpOutput::Sent { to: BusAddress(2) }, "{format:?} {length}");
            let mut text = String::new();
            receiver.stdout.take().unwrap().read_to_string(&mut text).unwrap();
            receiver.wait().unwrap();
            let received: Vec<u8> =
                text.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
            assert!(received == sent, "{format:?} {wishes} {length}: {}", received.len());
            // From the kernel.
            let mut sender = kernel("isotpsend", options);
            let text: String = sent.iter().map(|byte| format!("{byte:02X} ")).collect();
            sender.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
            let from = BusAddress(2);
            let expected = IsoTpOutput::Received { from, message: sent };
            assert!(ours.run() == expected, "{format:?} {wishes} {length}");
            sender.wait().unwrap();
        };
    for length in [1, 6, 7, 8, 62, 63, 100, 1000, 4095] {
        check(Format::Classic, "", 0, 0, length);
        check(FD, "", 0, 0, length);
    }
    // Longer than 12 bits can say.
    check(Format::Classic, "", 0, 0, 4096);
    check(FD, "", 0, 0, 4999);
    // Blocks and pauses, both ways.
    check(Format::Classic, "-b 4 -m 1", 3, 2, 200);
    check(FD, "-b 1 -m F5", 2, 1, 1000);
}

/// Our adapter's side of SLCAN at `ttyS2`, bridged to `vcan0`, for the kernel's driver at `ttyS1`.
async fn serve(mut port: tokio_serial::SerialStream, said: actix::Recipient<Said>) {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let bus = CanFdSocket::open("vcan0").unwrap();
    bus.set_nonblocking(true).unwrap();
    let mut lines = LineSplitter::default();
    let mut buffer = [0; 1024];
    loop {
        let mut answers = Vec::new();
        while let Ok(frame) = bus.read_frame() {
            if let Some(frame) = from_socket(&frame) {
                AdapterReply::Frame(frame).encode(&mut answers);
            }
        }
        let heard = tokio::time::timeout(
            Duration::from_millis(1),
            AsyncReadExt::read(&mut port, &mut buffer),
        )
        .await;
        let heard = heard.map_or(0, |read| read.unwrap());
        for byte in &buffer[..heard] {
            let Some(slcan::LineEnd::Whole(line)) = lines.handle_byte(*byte) else {
                continue;
            };
            match Line::decode(&line) {
                Some(Line::Send(frame)) => {
                    let id = ExtendedId::new(frame.id().number()).unwrap();
                    bus.write_frame(&CanDataFrame::new(id, frame.data()).unwrap()).unwrap();
                    AdapterReply::Sent.encode(&mut answers);
                }
                Some(command) => {
                    said.do_send(Said(command));
                    AdapterReply::Done.encode(&mut answers);
                }
                None => AdapterReply::Refused.encode(&mut answers),
            }
        }
        AsyncWriteExt::write_all(&mut port, &answers).await.unwrap();
    }
}

/// A command of the kernel's driver.
#[derive(Debug, actix::Message)]
#[rtype(result = "()")]
struct Said(Line);

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn the_kernels_slcan_driver_understands_our_codec_and_ours_the_drivers() {
    let port = tokio_serial::new("/dev/ttyS2", 115_200);
    let port = tokio_serial::SerialStream::open(&port).unwrap();
    let said = Probe::start();
    tokio::task::spawn_local(serve(port, said.recipient()));
    sh("slcand -o -s6 -S 115200 ttyS1 slcan0");
    appears("/sys/class/net/slcan0").await;
    sh("/sbin/ip link set slcan0 up");
    for expected in [Line::Close, Line::BitRate(BitRate::of(500_000).unwrap()), Line::Open] {
        assert_eq!(said.expect().await.0, expected);
    }

    let (a, b) = (End::can("slcan0", 1), End::can("vcan0", 2));
    a.opened().await;
    b.opened().await;
    a.speak_with(&b, MediumAddress::Can(1), MediumAddress::Can(2)).await;
}

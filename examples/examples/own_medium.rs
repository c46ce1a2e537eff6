//! A medium of one's own, in one file: frames over two FIFOs of the file system. Everything above
//! it is as over any other medium: links, routes, sessions, faults.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::medium::{
    Bytes, FrameLane, FrameMedium, MediumAddress, MediumEvent, OpenedMedium, Reach, SendResult,
};
use blastema::prelude::*;
use blastema::{Link, Network};
use std::io;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::task::{self, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::unix::pipe;

/// What the system writes into a FIFO in one piece or not at all (`PIPE_BUF` of Linux).
const ONE_PIECE: usize = 4096;
/// Each frame has its length before it.
const HEADER: usize = 2;

/// Two FIFOs, one for each way.
struct Fifos {
    /// Where we read.
    own: PathBuf,
    /// Where the other end does.
    far: PathBuf,
    open: Option<(pipe::Receiver, pipe::Sender)>,
    arrived: Vec<u8>,
}

impl Fifos {
    fn new(own: PathBuf, far: PathBuf) -> Self {
        Fifos { own, far, open: None, arrived: Vec::new() }
    }

    /// Takes the first frame from what has arrived, if it is all there.
    fn frame(&mut self) -> Option<Bytes> {
        let (header, rest) = self.arrived.split_first_chunk::<HEADER>()?;
        let frame = rest.get(..u16::from_be_bytes(*header).into())?;
        let frame = Bytes::copy_from_slice(frame);
        self.arrived.drain(..HEADER + frame.len());
        Some(frame)
    }
}

impl FrameMedium for Fifos {
    fn name(&self) -> String {
        format!("fifo {}", self.own.display())
    }

    fn reach(&self) -> Reach {
        Reach::Computer // without this, a node without keys would refuse the network
    }

    fn open(&mut self) -> io::Result<OpenedMedium> {
        // For reading and writing, so that neither end must be there first, nor notices the other
        // go.
        let mut options = pipe::OpenOptions::new();
        options.read_write(true);
        self.open = Some((options.open_receiver(&self.own)?, options.open_sender(&self.far)?));
        Ok(OpenedMedium { local: MediumAddress::Line, mtu: ONE_PIECE - HEADER })
    }

    fn knows(&self, address: &MediumAddress) -> bool {
        *address == MediumAddress::Line // there is only the other end
    }

    fn poll_send(
        &mut self,
        task: &mut task::Context<'_>,
        _: &MediumAddress,
        frame: &Bytes,
        _: FrameLane,
    ) -> Poll<io::Result<SendResult>> {
        let Some((_, sender)) = &mut self.open else { return Poll::Ready(Ok(SendResult::Dropped)) };
        let length = (frame.len() as u16).to_be_bytes(); // it is within the mtu
        let piece = [&length, &frame[..]].concat();
        ready!(Pin::new(sender).poll_write(task, &piece))?;
        Poll::Ready(Ok(SendResult::Sent))
    }

    fn poll_receive(&mut self, task: &mut task::Context<'_>) -> Poll<io::Result<MediumEvent>> {
        loop {
            if let Some(frame) = self.frame() {
                return Poll::Ready(Ok(MediumEvent::Frame { from: MediumAddress::Line, frame }));
            }
            let Some((receiver, _)) = &mut self.open else { return Poll::Pending };
            let mut chunk = [0; ONE_PIECE];
            let mut buffer = ReadBuf::new(&mut chunk);
            ready!(Pin::new(receiver).poll_read(task, &mut buffer))?;
            self.arrived.extend_from_slice(buffer.filled());
        }
    }

    fn close(&mut self) {
        self.open = None;
        self.arrived.clear();
    }
}

/// Asks for a square.
#[derive(Debug, Request)]
#[contract(name = "square", reply = u64)]
struct Square(u64);

struct Calculator;

impl Component for Calculator {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Square>();
    }
}

impl Handle<Square> for Calculator {
    async fn handle(&mut self, square: Square, _: &mut Context<Self>) -> u64 {
        square.0 * square.0
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
    for fifo in [&a, &b] {
        make_fifo(fifo)?;
    }

    let module2 = Node::builder("module2")
        .network(Network::own("fifos", Fifos::new(b.clone(), a.clone())).peer("module1", ""))
        .child(ChildSpec::new("calculator", || Calculator))
        .start()
        .await?;
    let module1 = Node::builder("module1")
        .network(Network::own("fifos", Fifos::new(a, b)).link(Link::to("module2", "").cost(5)))
        .start()
        .await?;
    assert!(module1.connected("module2", Duration::from_secs(10)).await);

    let calculator: Sender<Square> = module1.sender("module2:calculator")?;
    for number in [3, 12] {
        println!("{number} squared is {}", calculator.ask(Square(number)).await?);
    }
    module1.shutdown().await;
    module2.shutdown().await;
    Ok(())
}

fn make_fifo(path: &Path) -> io::Result<()> {
    use rustix::fs::{CWD, FileType, Mode, mknodat};
    Ok(mknodat(CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0)?)
}

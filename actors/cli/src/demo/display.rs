//! What is shown, on a thread of its own: a terminal that stands still holds nobody up.

use super::scenario::ProgressLine;
use super::text_style::{Palette, StyledLine};
use super::view::{DemoView, Size, plain_news};
use std::io::{self, IsTerminal, Write};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

/// Lines that may wait for a slow reader. More are left out: the table at the end does not depend on
/// them.
const QUEUE: usize = 1_024;

/// The director's end.
#[derive(Debug)]
pub(crate) struct Display {
    mode: Mode,
    queue: Option<SyncSender<Show>>,
    thread: Option<JoinHandle<()>>,
}

/// In which form a run is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// A live picture, redrawn in place.
    Live,
    /// A line for each piece of news.
    Lines,
    /// Nothing until the end.
    Silent,
}

/// Nobody reads what is shown any more.
#[derive(Debug, thiserror::Error)]
#[error("nobody reads the output any more")]
pub(crate) struct OutputClosed;

#[derive(Debug)]
enum Show {
    View(Box<DemoView>),
    Progress(ProgressLine),
    End(Vec<StyledLine>),
    Document(String),
}

impl Mode {
    /// The form that fits where standard output goes.
    pub(crate) fn choose(json: bool) -> Mode {
        let is_dumb = std::env::var_os("TERM").is_none_or(|term| term.is_empty() || term == "dumb");
        match (json, io::stdout().is_terminal() && !is_dumb) {
            (true, _) => Mode::Silent,
            (false, true) => Mode::Live,
            (false, false) => Mode::Lines,
        }
    }
}

impl Display {
    /// Starts the thread.
    ///
    /// # Errors
    /// The operating system has no thread left.
    pub(crate) fn start(mode: Mode) -> io::Result<Display> {
        let (queue, shows) = sync_channel(QUEUE);
        let thread = std::thread::Builder::new().name("display".into());
        // An error of standard output ends the thread; the director learns it at the next call.
        let thread = thread.spawn(move || drop(Screen::new(mode).show_all(&shows)))?;
        Ok(Display { mode, queue: Some(queue), thread: Some(thread) })
    }

    /// The form of the run.
    pub(crate) fn mode(&self) -> Mode {
        self.mode
    }

    /// Shows how things stand; left out if the terminal is behind.
    ///
    /// # Errors
    /// [`OutputClosed`].
    pub(crate) fn picture(&self, picture: DemoView) -> Result<(), OutputClosed> {
        self.show(Show::View(Box::new(picture)))
    }

    /// Shows a piece of news; left out if the reader is far behind.
    ///
    /// # Errors
    /// [`OutputClosed`].
    pub(crate) fn news(&self, news: ProgressLine) -> Result<(), OutputClosed> {
        self.show(Show::Progress(news))
    }

    /// Shows the end of a run, whole, and gives the terminal back.
    pub(crate) fn end(mut self, lines: Vec<StyledLine>) {
        self.finish_with(Show::End(lines));
    }

    /// Shows the end of a run as a document.
    pub(crate) fn document(mut self, text: String) {
        self.finish_with(Show::Document(text));
    }

    /// How wide the terminal is.
    pub(crate) fn columns(&self) -> usize {
        size().columns
    }

    fn show(&self, show: Show) -> Result<(), OutputClosed> {
        match self.queue.as_ref().map(|queue| queue.try_send(show)) {
            Some(Err(TrySendError::Disconnected(_))) => Err(OutputClosed),
            _ => Ok(()),
        }
    }

    fn finish_with(&mut self, show: Show) {
        // If nobody reads, there is nobody to tell that nobody reads.
        let _ = self.queue.take().map(|queue| queue.send(show));
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        self.queue = None;
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// The thread's end. It gives the terminal back however it ends.
struct Screen {
    mode: Mode,
    palette: Palette,
    drawn: usize,
    size: Option<Size>,
}

impl Screen {
    fn new(mode: Mode) -> Screen {
        let wants_none = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
        let palette =
            if mode == Mode::Live && !wants_none { Palette::Colours } else { Palette::Plain };
        Screen { mode, palette, drawn: 0, size: None }
    }

    fn show_all(mut self, shows: &Receiver<Show>) -> io::Result<()> {
        while let Ok(show) = shows.recv() {
            let text = match show {
                Show::View(picture) if self.mode == Mode::Live => self.redrawn(&picture, size()),
                Show::Progress(news) if self.mode == Mode::Lines => plain_news(&news) + "\n",
                Show::End(lines) => {
                    let lines = lines.iter().map(|line| line.paint(self.palette) + "\n");
                    lines.collect()
                }
                Show::Document(text) => text,
                Show::View(_) | Show::Progress(_) => continue,
            };
            write(&text)?;
        }
        Ok(())
    }

    /// The picture in the place of the one before it. Each line is cleared behind its end; the
    /// terminal shows all of it at once if it can.
    fn redrawn(&mut self, picture: &DemoView, size: Size) -> String {
        let mut text = String::from("\x1b[?2026h\x1b[?25l");
        if self.size.is_some_and(|old| old != size) {
            // What was drawn is wrapped differently now; nobody knows where it begins.
            text.push_str("\x1b[2J\x1b[H");
        } else if self.drawn > 0 {
            text.push_str(&format!("\x1b[{}A\r", self.drawn));
        }
        let lines = picture.draw(size);
        for line in &lines {
            text.push_str(&line.paint(self.palette));
            text.push_str("\x1b[K\n");
        }
        text.push_str("\x1b[J\x1b[?2026l");
        self.drawn = lines.len();
        self.size = Some(size);
        text
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        if self.size.is_some() {
            // There is no other way to the terminal if this one fails.
            let _ = write("\x1b[?2026l\x1b[?25h");
        }
    }
}

fn write(text: &str) -> io::Result<()> {
    let mut stdout = io::stdout().lock();
    stdout.write_all(text.as_bytes())?;
    stdout.flush()
}

/// The size of the terminal; where there is none, that of a wide page.
fn size() -> Size {
    let tells = rustix::termios::tcgetwinsize(io::stdout()).ok();
    let size = tells.map(|size| Size { columns: size.ws_col.into(), rows: size.ws_row.into() });
    // Some terminals know their size to be zero.
    size.filter(|size| size.columns > 0 && size.rows > 0).unwrap_or(Size { columns: 140, rows: 24 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::machine_instant::MachineInstant;
    use crate::demo::scenario::{Scenario, ScenarioPlan};
    use std::collections::VecDeque;

    fn picture() -> DemoView {
        let scenario = Scenario::new(ScenarioPlan::default(), MachineInstant::default());
        DemoView::new(&scenario, &VecDeque::new(), MachineInstant::default())
    }

    #[test]
    fn a_picture_takes_the_place_of_the_one_before_and_a_resized_terminal_is_cleared() {
        let mut screen = Screen::new(Mode::Lines);
        let (small, large) = (Size { columns: 80, rows: 24 }, Size { columns: 90, rows: 30 });

        let first = screen.redrawn(&picture(), small);
        let drawn = screen.drawn;
        let second = screen.redrawn(&picture(), small);
        let third = screen.redrawn(&picture(), large);
        screen.size = None;

        assert!(!first.contains("\x1b[2J") && first.matches('\n').count() == drawn);
        assert!(second.contains(&format!("\x1b[{drawn}A")), "{second:?}");
        assert!(third.contains("\x1b[2J\x1b[H"), "{third:?}");
    }
}

//! Writes to standard output from a thread of its own, so that a slow terminal delays no other
//! part.

use super::scenario::ProgressLine;
use super::view::{DemoView, plain_line};
use ratatui::Terminal;
use ratatui::backend::CrosstermBackend;
use ratatui::crossterm::cursor::Show as ShowCursor;
use ratatui::crossterm::execute;
use ratatui::crossterm::terminal::{EnterAlternateScreen, LeaveAlternateScreen};
use std::io::{self, IsTerminal, Stdout, Write};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

/// Lines that may wait for a slow reader. Further lines are left out: the table at the end does not
/// depend on them.
const QUEUE: usize = 1_024;
/// The width of the table where standard output is no terminal.
const PAGE: u16 = 140;

/// The director's end of the display.
#[derive(Debug)]
pub(crate) struct Display {
    mode: Mode,
    queue: Option<SyncSender<Show>>,
    thread: Option<JoinHandle<()>>,
}

/// In which form a run is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// A live view on the terminal's alternate screen.
    Live,
    /// One line for each step.
    Lines,
    /// No output until the end.
    Silent,
}

/// The reader of standard output has closed it.
#[derive(Debug, thiserror::Error)]
#[error("standard output was closed by its reader")]
pub(crate) struct OutputClosed;

#[derive(Debug)]
enum Show {
    View(Box<DemoView>),
    Progress(ProgressLine),
    End(String),
}

impl Mode {
    /// Returns the form that fits standard output.
    pub(crate) fn choose(json: bool) -> Mode {
        let is_dumb = std::env::var_os("TERM").is_none_or(|term| term.is_empty() || term == "dumb");
        match (json, io::stdout().is_terminal() && !is_dumb && columns().is_some()) {
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
    /// The operating system refuses another thread.
    pub(crate) fn start(mode: Mode) -> io::Result<Display> {
        let (queue, shows) = sync_channel(QUEUE);
        let thread = std::thread::Builder::new().name("display".into());
        // An error of standard output ends the thread; the director's next call returns it.
        let thread = thread.spawn(move || drop(Screen::new(mode).show_all(&shows)))?;
        Ok(Display { mode, queue: Some(queue), thread: Some(thread) })
    }

    /// Returns the form of the run.
    pub(crate) fn mode(&self) -> Mode {
        self.mode
    }

    /// Draws the view. A terminal that is behind does not get it.
    ///
    /// # Errors
    /// [`OutputClosed`].
    pub(crate) fn view(&self, view: DemoView) -> Result<(), OutputClosed> {
        self.show(Show::View(Box::new(view)))
    }

    /// Writes a progress line. A reader that is far behind does not get it.
    ///
    /// # Errors
    /// [`OutputClosed`].
    pub(crate) fn progress(&self, line: ProgressLine) -> Result<(), OutputClosed> {
        self.show(Show::Progress(line))
    }

    /// Restores the terminal and writes the end of a run in full.
    pub(crate) fn end(mut self, text: String) {
        // With standard output closed, there is no place left for the text.
        let _ = self.queue.take().map(|queue| queue.send(Show::End(text)));
        let _ = self.thread.take().map(JoinHandle::join);
    }

    /// Returns the width of the terminal, or of a page.
    pub(crate) fn columns(&self) -> u16 {
        columns().unwrap_or(PAGE)
    }

    fn show(&self, show: Show) -> Result<(), OutputClosed> {
        match self.queue.as_ref().map(|queue| queue.try_send(show)) {
            Some(Err(TrySendError::Disconnected(_))) => Err(OutputClosed),
            _ => Ok(()),
        }
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        self.queue = None;
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// The thread's end. It restores the terminal on every path.
struct Screen {
    mode: Mode,
    terminal: Option<Terminal<CrosstermBackend<Stdout>>>,
}

impl Screen {
    fn new(mode: Mode) -> Screen {
        Screen { mode, terminal: None }
    }

    fn show_all(mut self, shows: &Receiver<Show>) -> io::Result<()> {
        while let Ok(show) = shows.recv() {
            match show {
                Show::View(view) if self.mode == Mode::Live => {
                    self.terminal()?.draw(|frame| frame.render_widget(&*view, frame.area()))?;
                }
                Show::Progress(line) if self.mode == Mode::Lines => {
                    write(&(plain_line(&line) + "\n"))?
                }
                Show::End(text) => {
                    self.restore()?;
                    write(&text)?;
                }
                Show::View(_) | Show::Progress(_) => {}
            }
        }
        Ok(())
    }

    fn terminal(&mut self) -> io::Result<&mut Terminal<CrosstermBackend<Stdout>>> {
        if self.terminal.is_none() {
            execute!(io::stdout(), EnterAlternateScreen)?;
            self.terminal = Some(Terminal::new(CrosstermBackend::new(io::stdout()))?);
        }
        Ok(self.terminal.as_mut().expect("it has just been opened"))
    }

    fn restore(&mut self) -> io::Result<()> {
        match self.terminal.take() {
            Some(_) => execute!(io::stdout(), LeaveAlternateScreen, ShowCursor),
            None => Ok(()),
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        // A terminal that is closed needs no restoring.
        let _ = self.restore();
    }
}

fn write(text: &str) -> io::Result<()> {
    let mut stdout = io::stdout().lock();
    stdout.write_all(text.as_bytes())?;
    stdout.flush()
}

/// The width of the terminal. Some terminals report a size of zero: for them there is none.
fn columns() -> Option<u16> {
    let size = rustix::termios::tcgetwinsize(io::stdout()).ok()?;
    (size.ws_col > 0 && size.ws_row > 0).then_some(size.ws_col)
}

//! The live picture: three modules, the cables between them, their objects, the last news.
//!
//! Wide terminals get boxes, narrow ones a list, and of a short one the beginning is shown. What was
//! not heard of lately is not shown as current.

use super::flow_accounting::Losses;
use super::machine_instant::Moment;
use super::protocol::{ObjectState, Opinion};
use super::robot::{CABLES, Cable, Module};
use super::robot_state::Known;
use super::scenario::{News, Story, Tone};
use super::text_style::{Ink, Line};
use blastema::core::Lifecycle;
use std::collections::VecDeque;
use std::time::Duration;

/// What a person sees at a moment.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Picture {
    elapsed: Duration,
    caption: String,
    steps: Option<usize>,
    modules: [ModuleView; 3],
    cables: Vec<(Cable, Look)>,
    messages: Losses,
    received: u64,
    news: Vec<News>,
}

/// How large the terminal is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Size {
    /// Characters in a line.
    pub(crate) columns: usize,
    /// Lines.
    pub(crate) rows: usize,
}

#[derive(Clone, Debug, PartialEq)]
struct ModuleView {
    module: Module,
    look: Look,
    components: Vec<(&'static str, Look)>,
    skin: Vec<Look>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Look {
    Well,
    Suspect,
    Down,
    Unknown,
}

/// Older than this, a snapshot says nothing about now: five were missed.
const STALE: Duration = Duration::from_millis(500);
/// The width of a module's box.
const BOX: usize = 18;
/// The width of the cables between two boxes.
const GAP: usize = 12;
/// What the boxes and the cables take.
const WIDE: usize = 3 * BOX + 2 * GAP;
/// The skin's cells in a line of a box.
const CELLS: usize = 12;
/// News that are kept for the picture; no terminal that people use is higher.
pub(crate) const NEWS_LIMIT: usize = 60;

impl Picture {
    /// How things stand.
    pub(crate) fn new(story: &Story, news: &VecDeque<News>, now: Moment) -> Picture {
        let known = &story.known;
        Picture {
            elapsed: now - story.began_at(),
            caption: story.caption(),
            steps: story.steps(),
            modules: [Module::Module2, Module::Module1, Module::Module3]
                .map(|module| ModuleView::new(known, module, now)),
            cables: CABLES.iter().map(|cable| (*cable, look_of_cable(known, cable, now))).collect(),
            messages: known.ledger.losses(),
            received: known.ledger.received(),
            news: news.iter().cloned().collect(),
        }
    }

    /// The lines, none wider and no more than the terminal takes.
    pub(crate) fn draw(&self, size: Size) -> Vec<Line> {
        let mut lines = vec![self.title(), self.caption_line()];
        if size.columns >= WIDE && size.rows >= 14 {
            lines.push(Line::default());
            lines.extend(self.boxes());
            lines.push(Line::default());
        } else {
            lines.extend(self.modules.iter().map(ModuleView::line));
            lines.extend(self.cables.iter().map(cable_line));
        }
        lines.push(self.traffic());
        // The last line stays free, so that the terminal does not scroll.
        let room = size.rows.saturating_sub(1);
        let space = room.saturating_sub(lines.len());
        let first = self.news.len().saturating_sub(space);
        lines.extend(self.news[first..].iter().map(news_line));
        lines.truncate(room);
        lines.into_iter().map(|line| line.at_most(size.columns)).collect()
    }

    fn title(&self) -> Line {
        let steps = self.steps.map(|steps| format!(" · {steps} faults")).unwrap_or_default();
        let text = format!(" · {:5.1} s{steps}", self.elapsed.as_secs_f64());
        Line::of(Ink::Strong, "Blastema, a robot of three processes").and(Ink::Plain, text)
    }

    fn caption_line(&self) -> Line {
        Line::of(Ink::Warning, format!("▶ {}", self.caption))
    }

    fn traffic(&self) -> Line {
        let Losses { lost, doubled, perished } = self.messages;
        let ink = |count| if count == 0 { Ink::Good } else { Ink::Bad };
        Line::of(Ink::Plain, format!("reliable messages: {} received, ", self.received))
            .and(ink(lost), format!("{lost} lost"))
            .and(Ink::Plain, ", ")
            .and(ink(doubled), format!("{doubled} doubled"))
            .and(Ink::Faint, format!(", {perished} perished"))
    }

    fn boxes(&self) -> Vec<Line> {
        let [left, middle, right] = self.modules.each_ref().map(ModuleView::framed);
        let cables = [Module::Module2, Module::Module3].map(|far| self.between(far));
        let columns =
            [(&left, BOX), (&cables[0], GAP), (&middle, BOX), (&cables[1], GAP), (&right, BOX)];
        let height = columns.iter().map(|(lines, _)| lines.len()).max().unwrap_or_default();
        let row = |at: usize| {
            let mut line = Line::default();
            for (column, width) in columns {
                line.append(column.get(at).cloned().unwrap_or_default().exactly(width));
            }
            line
        };
        (0..height).map(row).collect()
    }

    fn between(&self, far: Module) -> Vec<Line> {
        let mut lines = vec![Line::default()];
        for (cable, look) in self.cables.iter().filter(|(cable, _)| cable.far == far) {
            lines.push(Line::of(Ink::Faint, format!("{:^GAP$}", cable.name)));
            lines.push(Line::of(look.ink(), wire(*look)));
            lines.push(Line::default());
        }
        lines
    }
}

impl ModuleView {
    fn new(known: &Known, module: Module, now: Moment) -> ModuleView {
        let state = known.module(module);
        let age = known.heard_at(module).map(|at| now - at);
        let is_heard = age.is_some_and(|age| age < STALE);
        let look = match state {
            None => Look::Unknown,
            Some(state) if !state.ready => Look::Down,
            Some(_) if is_heard => Look::Well,
            Some(_) => Look::Suspect,
        };
        let objects = state.filter(|_| is_heard).map_or(&[][..], |state| &state.snapshot.objects);
        let look_of = |name: &str| {
            objects.iter().find(|object| object.name == name).map_or(Look::Unknown, Look::of)
        };
        let cell = |number| look_of(&super::robot::skin(number));
        ModuleView {
            module,
            look,
            components: module.components().iter().map(|name| (*name, look_of(name))).collect(),
            skin: module.skin().map(cell).collect(),
        }
    }

    /// In a box.
    fn framed(&self) -> Vec<Line> {
        let inner = BOX - 4;
        let heading = format!("─ {} ", self.module);
        let rest = "─".repeat(BOX - 2 - heading.chars().count());
        let ink = self.look.ink();
        let mut lines = vec![Line::of(ink, format!("┌{heading}{rest}┐"))];
        let mut put = |content: Line| {
            let mut line = Line::of(ink, "│ ");
            line.append(content.exactly(inner));
            lines.push(line.and(ink, " │"));
        };
        for (name, look) in &self.components {
            put(Line::of(look.ink(), look.glyph()).and(Ink::Plain, format!(" {name}")));
        }
        for cells in self.skin.chunks(CELLS) {
            let mut line = Line::of(Ink::Plain, " ");
            for look in cells {
                line = line.and(look.ink(), look.glyph());
            }
            put(line);
        }
        lines.push(Line::of(ink, format!("└{}┘", "─".repeat(BOX - 2))));
        lines
    }

    /// In one line.
    fn line(&self) -> Line {
        let mut line = Line::of(self.look.ink(), format!("{} {}", self.look.glyph(), self.module));
        for (name, look) in &self.components {
            line = line.and(look.ink(), format!("  {} {name}", look.glyph()));
        }
        let well = self.skin.iter().filter(|look| **look == Look::Well).count();
        let ink = if well == self.skin.len() { Ink::Good } else { Ink::Warning };
        line.and(ink, format!("  skin {well}/{}", self.skin.len()))
    }
}

impl Look {
    fn of(object: &ObjectState) -> Look {
        match (object.opinion, object.state) {
            (Opinion::Trusted, Lifecycle::Active) => Look::Well,
            (Opinion::Suspect, _) => Look::Suspect,
            (Opinion::Failed, _) | (_, Lifecycle::Error | Lifecycle::Fatal) => Look::Down,
            (Opinion::Trusted, _) => Look::Suspect,
        }
    }

    fn ink(self) -> Ink {
        match self {
            Look::Well => Ink::Good,
            Look::Suspect => Ink::Warning,
            Look::Down => Ink::Bad,
            Look::Unknown => Ink::Faint,
        }
    }

    fn glyph(self) -> &'static str {
        match self {
            Look::Well => "●",
            Look::Suspect => "◐",
            Look::Down => "✗",
            Look::Unknown => "·",
        }
    }
}

fn look_of_cable(known: &Known, cable: &Cable, now: Moment) -> Look {
    let is_heard = |end: &Module| known.heard_at(*end).is_some_and(|at| now - at < STALE);
    match (cable.ends().iter().any(is_heard), known.is_up(cable)) {
        (false, _) => Look::Unknown,
        (true, true) => Look::Well,
        (true, false) => Look::Down,
    }
}

fn wire(look: Look) -> &'static str {
    match look {
        Look::Well | Look::Suspect => "━━━━━━━━━━━━",
        Look::Down => "━━━━╸  ╺━━━━",
        Look::Unknown => "┄┄┄┄┄┄┄┄┄┄┄┄",
    }
}

fn cable_line((cable, look): &(Cable, Look)) -> Line {
    let text = format!("{} {} {}", look.glyph(), cable.name, Module::Module1);
    Line::of(look.ink(), format!("{text} to {}", cable.far))
}

fn news_line(news: &News) -> Line {
    let ink = match news.tone {
        Tone::Deed => Ink::Warning,
        Tone::Finding => Ink::Plain,
        Tone::Relief => Ink::Good,
        Tone::Alarm => Ink::Bad,
        Tone::Remark => Ink::Faint,
    };
    Line::of(Ink::Faint, format!("{:7.3}  ", news.after.as_secs_f64())).and(ink, news.text.clone())
}

/// A piece of news as a line of its own, where there is no terminal.
pub(crate) fn plain_news(news: &News) -> String {
    let mark = match news.tone {
        Tone::Deed => ">",
        Tone::Finding => "!",
        Tone::Relief => "+",
        Tone::Alarm => "X",
        Tone::Remark => " ",
    };
    let text: String = news.text.chars().filter(|c| !c.is_control()).collect();
    format!("{:8.3} {mark} {text}", news.after.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::text_style::Palette;
    use crate::golden;

    fn picture() -> Picture {
        let view = |module: Module, look| ModuleView {
            module,
            look,
            components: module.components().iter().map(|name| (*name, Look::Well)).collect(),
            skin: module.skin().map(|_| Look::Well).collect(),
        };
        let mut modules = [
            view(Module::Module2, Look::Well),
            view(Module::Module1, Look::Well),
            view(Module::Module3, Look::Suspect),
        ];
        modules[0].components[0].1 = Look::Down;
        modules[0].skin[3] = Look::Suspect;
        modules[2].skin.fill(Look::Unknown);
        let mut cables: Vec<_> = CABLES.iter().map(|cable| (*cable, Look::Well)).collect();
        cables[0].1 = Look::Down;
        let news = |millis, tone, text: &str| News {
            after: Duration::from_millis(millis),
            tone,
            text: text.into(),
        };
        Picture {
            elapsed: Duration::from_millis(4_321),
            caption: "2: hang in module2:laser".into(),
            steps: Some(10),
            modules,
            cables,
            messages: Losses { lost: 0, doubled: 1, perished: 7 },
            received: 1_234,
            news: vec![
                news(3_000, Tone::Relief, "recovered after 61.0µs"),
                news(4_100, Tone::Deed, "hang in module2:laser"),
                news(4_300, Tone::Finding, "module2 found B03 hang in module2:laser"),
            ],
        }
    }

    fn text(columns: usize, rows: usize) -> String {
        let lines = picture().draw(Size { columns, rows });
        assert!(lines.len() < rows.max(1), "{} lines in {rows}", lines.len());
        let lines = lines.iter().map(|line| {
            assert!(line.width() <= columns, "{line:?}");
            line.paint(Palette::Plain) + "\n"
        });
        lines.collect()
    }

    #[test]
    fn a_wide_terminal_shows_boxes_and_cables() {
        golden::check("picture_wide.txt", &text(80, 24));
    }

    #[test]
    fn a_narrow_terminal_shows_a_list() {
        golden::check("picture_narrow.txt", &text(50, 24));
    }

    #[test]
    fn a_terminal_of_any_size_is_never_overrun() {
        for columns in [0, 1, 7, 40, 77, 78, 300] {
            for rows in [0, 1, 2, 5, 13, 14, 18, 100] {
                text(columns, rows);
            }
        }
    }

    #[test]
    fn what_was_not_heard_of_lately_does_not_look_current() {
        let known = crate::demo::fake::known();
        let heard = known.heard_at(Module::Module1).expect("it was just told");

        let fresh = ModuleView::new(&known, Module::Module1, heard);
        let stale = ModuleView::new(&known, Module::Module1, heard + STALE);

        assert_eq!((fresh.look, stale.look), (Look::Well, Look::Suspect));
        assert_eq!(look_of_cable(&known, &CABLES[0], heard), Look::Well);
        assert_eq!(look_of_cable(&known, &CABLES[0], heard + STALE), Look::Unknown);
    }

    #[test]
    fn a_line_of_news_stands_for_itself_where_there_is_no_terminal() {
        let lines: Vec<_> = picture().news.iter().map(plain_news).collect();

        assert_eq!(lines[1], "   4.100 > hang in module2:laser");
    }
}

//! The live picture: three modules, the cables between them, their objects, the last news.
//!
//! Wide terminals get boxes, narrow ones a list, and of a short one the beginning is shown. What was
//! not heard of lately is not shown as current.

use super::flow_accounting::FlowLosses;
use super::machine_instant::MachineInstant;
use super::protocol::{ObjectOpinion, ObjectState};
use super::robot::{CABLES, DemoCable, Module};
use super::robot_state::RobotState;
use super::scenario::{LineTone, ProgressLine, Scenario};
use super::text_style::{StyledLine, TextStyle};
use blastema::core::Lifecycle;
use std::collections::VecDeque;
use std::time::Duration;

/// What a person sees at a instant.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct DemoView {
    elapsed: Duration,
    caption: String,
    steps: Option<usize>,
    modules: [ModuleView; 3],
    cables: Vec<(DemoCable, Look)>,
    messages: FlowLosses,
    received: u64,
    news: Vec<ProgressLine>,
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
/// ProgressLine that are kept for the picture; no terminal that people use is higher.
pub(crate) const NEWS_LIMIT: usize = 60;

impl DemoView {
    /// How things stand.
    pub(crate) fn new(
        scenario: &Scenario,
        news: &VecDeque<ProgressLine>,
        now: MachineInstant,
    ) -> DemoView {
        let robot = &scenario.robot;
        DemoView {
            elapsed: now - scenario.began_at(),
            caption: scenario.caption(),
            steps: scenario.steps(),
            modules: [Module::Module2, Module::Module1, Module::Module3]
                .map(|module| ModuleView::new(robot, module, now)),
            cables: CABLES.iter().map(|cable| (*cable, look_of_cable(robot, cable, now))).collect(),
            messages: robot.accounting.losses(),
            received: robot.accounting.received(),
            news: news.iter().cloned().collect(),
        }
    }

    /// The lines, none wider and no more than the terminal takes.
    pub(crate) fn draw(&self, size: Size) -> Vec<StyledLine> {
        let mut lines = vec![self.title(), self.caption_line()];
        if size.columns >= WIDE && size.rows >= 14 {
            lines.push(StyledLine::default());
            lines.extend(self.boxes());
            lines.push(StyledLine::default());
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

    fn title(&self) -> StyledLine {
        let steps = self.steps.map(|steps| format!(" · {steps} faults")).unwrap_or_default();
        let text = format!(" · {:5.1} s{steps}", self.elapsed.as_secs_f64());
        StyledLine::of(TextStyle::Strong, "Blastema, a robot of three processes")
            .and(TextStyle::Plain, text)
    }

    fn caption_line(&self) -> StyledLine {
        StyledLine::of(TextStyle::Warning, format!("▶ {}", self.caption))
    }

    fn traffic(&self) -> StyledLine {
        let FlowLosses { lost, doubled, perished } = self.messages;
        let style = |count| if count == 0 { TextStyle::Good } else { TextStyle::Bad };
        StyledLine::of(TextStyle::Plain, format!("reliable messages: {} received, ", self.received))
            .and(style(lost), format!("{lost} lost"))
            .and(TextStyle::Plain, ", ")
            .and(style(doubled), format!("{doubled} doubled"))
            .and(TextStyle::Faint, format!(", {perished} perished"))
    }

    fn boxes(&self) -> Vec<StyledLine> {
        let [left, middle, right] = self.modules.each_ref().map(ModuleView::framed);
        let cables = [Module::Module2, Module::Module3].map(|far| self.between(far));
        let columns =
            [(&left, BOX), (&cables[0], GAP), (&middle, BOX), (&cables[1], GAP), (&right, BOX)];
        let height = columns.iter().map(|(lines, _)| lines.len()).max().unwrap_or_default();
        let row = |at: usize| {
            let mut line = StyledLine::default();
            for (column, width) in columns {
                line.append(column.get(at).cloned().unwrap_or_default().exactly(width));
            }
            line
        };
        (0..height).map(row).collect()
    }

    fn between(&self, far: Module) -> Vec<StyledLine> {
        let mut lines = vec![StyledLine::default()];
        for (cable, look) in self.cables.iter().filter(|(cable, _)| cable.far == far) {
            lines.push(StyledLine::of(TextStyle::Faint, format!("{:^GAP$}", cable.name)));
            lines.push(StyledLine::of(look.style(), wire(*look)));
            lines.push(StyledLine::default());
        }
        lines
    }
}

impl ModuleView {
    fn new(robot: &RobotState, module: Module, now: MachineInstant) -> ModuleView {
        let state = robot.module(module);
        let age = robot.heard_at(module).map(|at| now - at);
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
    fn framed(&self) -> Vec<StyledLine> {
        let inner = BOX - 4;
        let heading = format!("─ {} ", self.module);
        let rest = "─".repeat(BOX - 2 - heading.chars().count());
        let style = self.look.style();
        let mut lines = vec![StyledLine::of(style, format!("┌{heading}{rest}┐"))];
        let mut put = |content: StyledLine| {
            let mut line = StyledLine::of(style, "│ ");
            line.append(content.exactly(inner));
            lines.push(line.and(style, " │"));
        };
        for (name, look) in &self.components {
            put(StyledLine::of(look.style(), look.glyph())
                .and(TextStyle::Plain, format!(" {name}")));
        }
        for cells in self.skin.chunks(CELLS) {
            let mut line = StyledLine::of(TextStyle::Plain, " ");
            for look in cells {
                line = line.and(look.style(), look.glyph());
            }
            put(line);
        }
        lines.push(StyledLine::of(style, format!("└{}┘", "─".repeat(BOX - 2))));
        lines
    }

    /// In one line.
    fn line(&self) -> StyledLine {
        let mut line =
            StyledLine::of(self.look.style(), format!("{} {}", self.look.glyph(), self.module));
        for (name, look) in &self.components {
            line = line.and(look.style(), format!("  {} {name}", look.glyph()));
        }
        let well = self.skin.iter().filter(|look| **look == Look::Well).count();
        let style = if well == self.skin.len() { TextStyle::Good } else { TextStyle::Warning };
        line.and(style, format!("  skin {well}/{}", self.skin.len()))
    }
}

impl Look {
    fn of(object: &ObjectState) -> Look {
        match (object.opinion, object.state) {
            (ObjectOpinion::Trusted, Lifecycle::Active) => Look::Well,
            (ObjectOpinion::Suspect, _) => Look::Suspect,
            (ObjectOpinion::Failed, _) | (_, Lifecycle::Error | Lifecycle::Fatal) => Look::Down,
            (ObjectOpinion::Trusted, _) => Look::Suspect,
        }
    }

    fn style(self) -> TextStyle {
        match self {
            Look::Well => TextStyle::Good,
            Look::Suspect => TextStyle::Warning,
            Look::Down => TextStyle::Bad,
            Look::Unknown => TextStyle::Faint,
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

fn look_of_cable(robot: &RobotState, cable: &DemoCable, now: MachineInstant) -> Look {
    let is_heard = |end: &Module| robot.heard_at(*end).is_some_and(|at| now - at < STALE);
    match (cable.ends().iter().any(is_heard), robot.is_up(cable)) {
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

fn cable_line((cable, look): &(DemoCable, Look)) -> StyledLine {
    let text = format!("{} {} {}", look.glyph(), cable.name, Module::Module1);
    StyledLine::of(look.style(), format!("{text} to {}", cable.far))
}

fn news_line(news: &ProgressLine) -> StyledLine {
    let style = match news.tone {
        LineTone::Injection => TextStyle::Warning,
        LineTone::Finding => TextStyle::Plain,
        LineTone::Relief => TextStyle::Good,
        LineTone::Alarm => TextStyle::Bad,
        LineTone::Remark => TextStyle::Faint,
    };
    StyledLine::of(TextStyle::Faint, format!("{:7.3}  ", news.after.as_secs_f64()))
        .and(style, news.text.clone())
}

/// A piece of news as a line of its own, where there is no terminal.
pub(crate) fn plain_news(news: &ProgressLine) -> String {
    let mark = match news.tone {
        LineTone::Injection => ">",
        LineTone::Finding => "!",
        LineTone::Relief => "+",
        LineTone::Alarm => "X",
        LineTone::Remark => " ",
    };
    let text: String = news.text.chars().filter(|c| !c.is_control()).collect();
    format!("{:8.3} {mark} {text}", news.after.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::text_style::Palette;
    use crate::golden;

    fn picture() -> DemoView {
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
        let news = |millis, tone, text: &str| ProgressLine {
            after: Duration::from_millis(millis),
            tone,
            text: text.into(),
        };
        DemoView {
            elapsed: Duration::from_millis(4_321),
            caption: "2: hang in module2:laser".into(),
            steps: Some(10),
            modules,
            cables,
            messages: FlowLosses { lost: 0, doubled: 1, perished: 7 },
            received: 1_234,
            news: vec![
                news(3_000, LineTone::Relief, "recovered after 61.0µs"),
                news(4_100, LineTone::Injection, "hang in module2:laser"),
                news(4_300, LineTone::Finding, "module2 found B03 hang in module2:laser"),
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
        let robot = crate::demo::fake::robot_state();
        let heard = robot.heard_at(Module::Module1).expect("it was just told");

        let fresh = ModuleView::new(&robot, Module::Module1, heard);
        let stale = ModuleView::new(&robot, Module::Module1, heard + STALE);

        assert_eq!((fresh.look, stale.look), (Look::Well, Look::Suspect));
        assert_eq!(look_of_cable(&robot, &CABLES[0], heard), Look::Well);
        assert_eq!(look_of_cable(&robot, &CABLES[0], heard + STALE), Look::Unknown);
    }

    #[test]
    fn a_line_of_news_stands_for_itself_where_there_is_no_terminal() {
        let lines: Vec<_> = picture().news.iter().map(plain_news).collect();

        assert_eq!(lines[1], "   4.100 > hang in module2:laser");
    }
}

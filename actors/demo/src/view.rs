//! The live view: three modules, the cables between them, their objects, the latest progress lines.
//!
//! A wide terminal gets boxes, a narrow one gets a list. A module without a recent snapshot is not
//! shown as current.

use super::flow_accounting::FlowLosses;
use super::machine_instant::MachineInstant;
use super::protocol::{ObjectOpinion, ObjectState};
use super::robot::{CABLES, DemoCable, Module, skin};
use super::robot_state::RobotState;
use super::scenario::{ProgressLine, Scenario};
use super::tone::LineTone;
use blastema::core::Lifecycle;
use ratatui::buffer::Buffer;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Widget};
use std::collections::VecDeque;
use std::time::Duration;

/// One frame of the live view.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct DemoView {
    elapsed: Duration,
    caption: String,
    steps: Option<usize>,
    modules: [ModuleView; 3],
    cables: Vec<(DemoCable, ModuleHealth)>,
    messages: FlowLosses,
    received: u64,
    lines: Vec<ProgressLine>,
}

#[derive(Clone, Debug, PartialEq)]
struct ModuleView {
    module: Module,
    health: ModuleHealth,
    components: Vec<(&'static str, ModuleHealth)>,
    skin: Vec<ModuleHealth>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ModuleHealth {
    Well,
    Suspect,
    Down,
    Unknown,
}

/// A snapshot older than this is out of date: five have been missed.
const STALE: Duration = Duration::from_millis(500);
/// The width of a module's box.
const BOX: u16 = 20;
/// The width of the cables between two boxes.
const GAP: u16 = 12;
/// The height of a module's box.
const HEIGHT: u16 = 7;
/// The boxes are drawn from this size on; a smaller terminal gets the list.
const WIDE: (u16, u16) = (3 * BOX + 2 * GAP, 14);
/// Skin cells in one line of a box.
const CELLS: usize = 14;
/// Progress lines that are kept for the view, more than a terminal has rows.
pub(crate) const LINE_LIMIT: usize = 60;

impl DemoView {
    /// Takes the state of the scenario at this instant.
    pub(crate) fn new(
        scenario: &Scenario,
        lines: &VecDeque<ProgressLine>,
        now: MachineInstant,
    ) -> DemoView {
        let robot = &scenario.robot;
        DemoView {
            elapsed: now - scenario.began_at(),
            caption: scenario.caption(),
            steps: scenario.steps(),
            modules: [Module::Module2, Module::Module1, Module::Module3]
                .map(|module| ModuleView::new(robot, module, now)),
            cables: CABLES.iter().map(|cable| (*cable, cable_health(robot, cable, now))).collect(),
            messages: robot.accounting.losses(),
            received: robot.accounting.received(),
            lines: lines.iter().cloned().collect(),
        }
    }

    fn heading(&self) -> Vec<Line<'_>> {
        let steps = self.steps.map(|steps| format!(" · {steps} faults")).unwrap_or_default();
        let clock = format!(" · {:5.1} s{steps}", self.elapsed.as_secs_f64());
        let title = Span::styled("Blastema, a robot of three processes", Modifier::BOLD);
        let caption = Span::styled(format!("▶ {}", self.caption), Color::Yellow);
        vec![Line::from(vec![title, clock.into()]), caption.into()]
    }

    fn messages(&self) -> Line<'static> {
        let FlowLosses { lost, doubled, perished, .. } = self.messages;
        let count = |count: u64, what: &str| {
            let colour = if count == 0 { Color::Green } else { Color::Red };
            Span::styled(format!("{count} {what}"), colour)
        };
        Line::from(vec![
            format!("reliable messages: {} received, ", self.received).into(),
            count(lost, "lost"),
            ", ".into(),
            count(doubled, "doubled"),
            Span::styled(format!(", {perished} lost with a killed process"), Modifier::DIM),
        ])
    }

    fn draw_boxes(&self, area: Rect, buffer: &mut Buffer) {
        let widths = [BOX, GAP, BOX, GAP, BOX].map(Constraint::Length);
        let [left, near, middle, far, right] = Layout::horizontal(widths).areas(area);
        for (module, area) in self.modules.iter().zip([left, middle, right]) {
            module.draw_box(area, buffer);
        }
        for (module, area) in [(Module::Module2, near), (Module::Module3, far)] {
            let cables = self.cables.iter().filter(|(cable, _)| cable.far == module);
            let lines = cables.flat_map(|(cable, health)| {
                let name = Line::styled(cable.name, Modifier::DIM).centered();
                [Line::default(), name, Line::styled(health.wire(), health.colour())]
            });
            Paragraph::new(lines.collect::<Vec<_>>()).render(area, buffer);
        }
    }

    fn list(&self) -> Vec<Line<'_>> {
        let cable = |(cable, health): &(DemoCable, ModuleHealth)| {
            let (glyph, far) = (health.glyph(), cable.far);
            let text = format!("{glyph} {} {} to {far}", cable.name, Module::Module1);
            Line::styled(text, health.colour())
        };
        self.modules.iter().map(ModuleView::line).chain(self.cables.iter().map(cable)).collect()
    }
}

impl Widget for &DemoView {
    fn render(self, area: Rect, buffer: &mut Buffer) {
        let is_wide = area.width >= WIDE.0 && area.height >= WIDE.1;
        let list = self.list();
        let robot = if is_wide { HEIGHT } else { list.len() as u16 };
        let [heading, robot, messages, lines] = Layout::vertical([
            Constraint::Length(2),
            Constraint::Length(robot),
            Constraint::Length(1),
            Constraint::Fill(1),
        ])
        .areas(area);
        Paragraph::new(self.heading()).render(heading, buffer);
        if is_wide {
            self.draw_boxes(robot, buffer);
        } else {
            Paragraph::new(list).render(robot, buffer);
        }
        self.messages().render(messages, buffer);
        let first = self.lines.len().saturating_sub(lines.height.into());
        let latest: Vec<_> = self.lines[first..].iter().map(styled_line).collect();
        Paragraph::new(latest).render(lines, buffer);
    }
}

impl ModuleView {
    fn new(robot: &RobotState, module: Module, now: MachineInstant) -> ModuleView {
        let state = robot.module(module);
        let age = robot.received_at(module).map(|at| now - at);
        let is_fresh = age.is_some_and(|age| age < STALE);
        let health = match state {
            None => ModuleHealth::Unknown,
            Some(state) if !state.ready => ModuleHealth::Down,
            Some(_) if is_fresh => ModuleHealth::Well,
            Some(_) => ModuleHealth::Suspect,
        };
        let objects = state.filter(|_| is_fresh).map_or(&[][..], |state| &state.snapshot.objects);
        let health_of = |name: &str| {
            objects
                .iter()
                .find(|object| object.name == name)
                .map_or(ModuleHealth::Unknown, ModuleHealth::of)
        };
        ModuleView {
            module,
            health,
            components: module.components().iter().map(|name| (*name, health_of(name))).collect(),
            skin: module.skin().map(|number| health_of(&skin(number))).collect(),
        }
    }

    fn draw_box(&self, area: Rect, buffer: &mut Buffer) {
        let component = |(name, health): &(&'static str, ModuleHealth)| {
            Line::from(vec![health.span(), format!(" {name}").into()])
        };
        let cells = |cells: &[ModuleHealth]| Line::from_iter(cells.iter().map(|cell| cell.span()));
        let components = self.components.iter().map(component);
        let lines: Vec<_> = components.chain(self.skin.chunks(CELLS).map(cells)).collect();
        let title = format!(" {} ", self.module);
        let frame = Block::bordered().title(title).border_style(self.health.colour());
        Paragraph::new(lines).block(frame).render(area, buffer);
    }

    /// The module in one line, for a narrow terminal.
    fn line(&self) -> Line<'_> {
        let part = |name: &str, health: ModuleHealth| {
            Span::styled(format!("{} {name}  ", health.glyph()), health.colour())
        };
        let well = self.skin.iter().filter(|cell| **cell == ModuleHealth::Well).count();
        let colour = if well == self.skin.len() { Color::Green } else { Color::Yellow };
        let skin = Span::styled(format!("skin {well}/{}", self.skin.len()), colour);
        let components = self.components.iter().map(|(name, health)| part(name, *health));
        let module = part(self.module.name(), self.health);
        std::iter::once(module).chain(components).chain([skin]).collect()
    }
}

impl ModuleHealth {
    fn of(object: &ObjectState) -> ModuleHealth {
        match (object.opinion, object.state) {
            (ObjectOpinion::Trusted, Lifecycle::Active) => ModuleHealth::Well,
            (ObjectOpinion::Suspect, _) => ModuleHealth::Suspect,
            (ObjectOpinion::Failed, _) | (_, Lifecycle::Error | Lifecycle::Fatal) => {
                ModuleHealth::Down
            }
            (ObjectOpinion::Trusted, _) => ModuleHealth::Suspect,
        }
    }

    fn colour(self) -> Color {
        match self {
            ModuleHealth::Well => Color::Green,
            ModuleHealth::Suspect => Color::Yellow,
            ModuleHealth::Down => Color::Red,
            ModuleHealth::Unknown => Color::DarkGray,
        }
    }

    fn glyph(self) -> &'static str {
        match self {
            ModuleHealth::Well => "●",
            ModuleHealth::Suspect => "◐",
            ModuleHealth::Down => "✗",
            ModuleHealth::Unknown => "·",
        }
    }

    fn span(self) -> Span<'static> {
        Span::styled(self.glyph(), self.colour())
    }

    fn wire(self) -> &'static str {
        match self {
            ModuleHealth::Well | ModuleHealth::Suspect => "━━━━━━━━━━━━",
            ModuleHealth::Down => "━━━━╸  ╺━━━━",
            ModuleHealth::Unknown => "┄┄┄┄┄┄┄┄┄┄┄┄",
        }
    }
}

fn cable_health(robot: &RobotState, cable: &DemoCable, now: MachineInstant) -> ModuleHealth {
    let is_fresh = |end: &Module| robot.received_at(*end).is_some_and(|at| now - at < STALE);
    match (cable.ends().iter().any(is_fresh), robot.is_up(cable)) {
        (false, _) => ModuleHealth::Unknown,
        (true, true) => ModuleHealth::Well,
        (true, false) => ModuleHealth::Down,
    }
}

fn styled_line(line: &ProgressLine) -> Line<'_> {
    let style = match line.tone {
        LineTone::Injection => Style::from(Color::Yellow),
        LineTone::Finding => Style::default(),
        LineTone::Relief => Style::from(Color::Green),
        LineTone::Alarm => Style::from(Color::Red),
        LineTone::Remark => Style::from(Modifier::DIM),
    };
    let clock = format!("{:7.3}  ", line.after.as_secs_f64());
    Line::from(vec![Span::styled(clock, Modifier::DIM), Span::styled(&line.text, style)])
}

/// A progress line as text, for an output that is no terminal.
pub(crate) fn plain_line(line: &ProgressLine) -> String {
    let mark = match line.tone {
        LineTone::Injection => ">",
        LineTone::Finding => "!",
        LineTone::Relief => "+",
        LineTone::Alarm => "X",
        LineTone::Remark => " ",
    };
    let text: String = line.text.chars().filter(|c| !c.is_control()).collect();
    format!("{:8.3} {mark} {text}", line.after.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden;

    fn view() -> DemoView {
        let module = |module: Module, health| ModuleView {
            module,
            health,
            components: module
                .components()
                .iter()
                .map(|name| (*name, ModuleHealth::Well))
                .collect(),
            skin: module.skin().map(|_| ModuleHealth::Well).collect(),
        };
        let mut modules = [
            module(Module::Module2, ModuleHealth::Well),
            module(Module::Module1, ModuleHealth::Well),
            module(Module::Module3, ModuleHealth::Suspect),
        ];
        modules[0].components[0].1 = ModuleHealth::Down;
        modules[0].skin[3] = ModuleHealth::Suspect;
        modules[2].skin.fill(ModuleHealth::Unknown);
        let mut cables: Vec<_> = CABLES.iter().map(|cable| (*cable, ModuleHealth::Well)).collect();
        cables[0].1 = ModuleHealth::Down;
        let line = |millis, tone, text: &str| ProgressLine {
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
            messages: FlowLosses { lost: 0, doubled: 1, perished: 7, returned: 0 },
            received: 1_234,
            lines: vec![
                line(3_000, LineTone::Relief, "recovered after 61.0µs"),
                line(4_100, LineTone::Injection, "2 of 10: hang in module2:laser"),
                line(4_300, LineTone::Finding, "module2 found B03 hang\x1b[2J in module2:laser"),
            ],
        }
    }

    fn text(width: u16, height: u16) -> String {
        let mut buffer = Buffer::empty(Rect::new(0, 0, width, height));
        view().render(buffer.area, &mut buffer);
        let rows = (0..height).map(|y| {
            let row: String = (0..width).map(|x| buffer[(x, y)].symbol()).collect();
            row.trim_end().to_owned() + "\n"
        });
        rows.collect()
    }

    #[test]
    fn a_wide_terminal_shows_boxes_and_cables() {
        golden::check("view_wide.txt", &text(84, 16));
    }

    #[test]
    fn a_narrow_terminal_shows_a_list() {
        golden::check("view_narrow.txt", &text(50, 14));
    }

    #[test]
    fn a_terminal_of_any_size_is_drawn_without_a_panic() {
        for width in [0, 1, 7, 40, 83, 84, 300] {
            for height in [0, 1, 2, 5, 13, 14, 18, 100] {
                text(width, height);
            }
        }
    }

    #[test]
    fn text_of_a_module_cannot_move_the_cursor() {
        assert!(!text(84, 16).contains('\x1b'));
        assert!(view().lines.iter().map(plain_line).all(|line| !line.contains('\x1b')));
    }

    #[test]
    fn a_module_without_a_recent_snapshot_does_not_look_current() {
        let robot = crate::fake::robot_state();
        let received_at = robot.received_at(Module::Module1).expect("its snapshot has arrived");

        let fresh = ModuleView::new(&robot, Module::Module1, received_at);
        let stale = ModuleView::new(&robot, Module::Module1, received_at + STALE);

        assert_eq!((fresh.health, stale.health), (ModuleHealth::Well, ModuleHealth::Suspect));
        assert_eq!(cable_health(&robot, &CABLES[0], received_at), ModuleHealth::Well);
        assert_eq!(cable_health(&robot, &CABLES[0], received_at + STALE), ModuleHealth::Unknown);
    }

    #[test]
    fn a_progress_line_stands_for_itself_where_there_is_no_terminal() {
        let lines: Vec<_> = view().lines.iter().map(plain_line).collect();

        assert_eq!(lines[1], "   4.100 > 2 of 10: hang in module2:laser");
    }
}

//! The table at the end, beside the paper's figures.

use super::report::{
    DeliveryTimes, FaultRow, LatencySummary, Report, ResponseTimes, counted, millis,
};
use super::text_style::{StyledLine, TextStyle};
use std::time::Duration;

/// What the wide form takes; narrower terminals get a paragraph for each row.
const WIDE: usize = 124;

/// Text is not wrapped to less.
const NARROWEST: usize = 40;

/// The table as lines; none is wider than `columns` where that can be.
pub(crate) fn draw(report: &Report, columns: usize) -> Vec<StyledLine> {
    let mut lines = vec![StyledLine::default()];
    if columns >= WIDE {
        lines.push(StyledLine::of(TextStyle::Strong, wide_heading()));
        lines.extend(report.rows.iter().flat_map(wide_row));
    } else {
        lines.extend(report.rows.iter().flat_map(narrow_row));
    }
    if report.rows_left_out > 0 {
        let rows = counted(report.rows_left_out, "earlier row");
        let text = format!("({rows} in which nothing broke)");
        lines.push(StyledLine::of(TextStyle::Faint, text));
    }
    lines.extend(
        report
            .problems
            .iter()
            .map(|problem| StyledLine::of(TextStyle::Bad, format!("! {problem}"))),
    );
    lines.push(StyledLine::default());
    lines.extend(responses(&report.responses));
    lines.extend(events(&report.events));
    lines.push(StyledLine::default());
    for note in &report.notes {
        lines.extend(
            wrapped(note, columns.clamp(NARROWEST, WIDE))
                .into_iter()
                .map(|text| StyledLine::of(TextStyle::Faint, text)),
        );
    }
    lines.push(StyledLine::default());
    lines.extend(verdict(report, columns));
    lines
}

fn wide_heading() -> String {
    format!(
        "{:>3}  {:<24} {:<30} {:<24} {:>9} {:>11} {:>5} {:>8}  {}",
        "", "fault", "where", "named as", "detected", "recovered", "lost", "doubled", "paper"
    )
}

fn wide_row(row: &FaultRow) -> Vec<StyledLine> {
    let figures = StyledLine::of(
        TextStyle::Plain,
        format!(
            "{:>3}  {:<24} {:<30} {:<24} {:>9} {:>10}{} ",
            row.number,
            row.fault,
            row.place,
            name(row),
            figure(row.detected_after),
            figure(row.recovered_after),
            if row.from_repair { "r" } else { " " },
        ),
    )
    .and(count_ink(row.lost), format!("{:>5}", row.lost))
    .and(count_ink(row.doubled), format!("{:>9}", row.doubled))
    .and(TextStyle::Plain, format!("  {}{}", perished(row), row.paper.unwrap_or_default()));
    let problems =
        row.problems.iter().map(|text| StyledLine::of(TextStyle::Bad, format!("     ! {text}")));
    std::iter::once(figures).chain(problems).collect()
}

fn narrow_row(row: &FaultRow) -> Vec<StyledLine> {
    let mut lines = vec![
        StyledLine::of(
            TextStyle::Strong,
            format!("{:>3} {} in {}", row.number, row.fault, row.place),
        ),
        StyledLine::of(
            TextStyle::Plain,
            format!(
                "    {}, detected {}, recovered {}{}",
                name(row),
                figure(row.detected_after),
                figure(row.recovered_after),
                if row.from_repair { " r" } else { "" },
            ),
        ),
        StyledLine::of(count_ink(row.lost), format!("    lost {}, ", row.lost))
            .and(count_ink(row.doubled), format!("doubled {}", row.doubled))
            .and(TextStyle::Plain, format!("  {}", perished(row))),
    ];
    if let Some(paper) = row.paper {
        lines.push(StyledLine::of(TextStyle::Plain, format!("    paper: {paper}")));
    }
    lines.extend(
        row.problems.iter().map(|text| StyledLine::of(TextStyle::Bad, format!("    ! {text}"))),
    );
    lines
}

fn responses(responses: &[ResponseTimes]) -> Vec<StyledLine> {
    let heading = format!(
        "{:<18} {:<9} {:>8} {:>9} {:>9} {:>9} {:>9}  {}",
        "response time", "over", "times", "mean", "median", "99 %", "worst", "paper's mean c"
    );
    let line = |response: &ResponseTimes| {
        let [one, other] = response.modules;
        let between = format!("{one}-{other}");
        let text = format!("{:<18} {:<9} {}", between, response.over, row_of(&response.figures));
        StyledLine::of(TextStyle::Plain, format!("{text}  {:.3}", response.paper_mean_ms))
    };
    std::iter::once(StyledLine::of(TextStyle::Strong, heading))
        .chain(responses.iter().map(line))
        .collect()
}

fn events(events: &[DeliveryTimes]) -> Vec<StyledLine> {
    let line = |delivery: &DeliveryTimes| {
        let what = if delivery.filtered { "filtered" } else { "unfiltered" };
        let figures = row_of(&delivery.figures);
        StyledLine::of(
            TextStyle::Plain,
            format!("{:<28} {figures}", format!("event delivery, {what}")),
        )
    };
    events.iter().map(line).collect()
}

fn row_of(figures: &LatencySummary) -> String {
    format!(
        "{:>8} {:>9} {:>9} {:>9} {:>9}",
        figures.count,
        figure(figures.mean),
        figure(figures.median),
        figure(figures.p99),
        figure(figures.worst),
    )
}

fn verdict(report: &Report, columns: usize) -> Vec<StyledLine> {
    let sum = &report.messages;
    let rows = report.rows.len() as u64 + report.rows_left_out;
    let is_broken =
        !report.problems.is_empty() || report.rows.iter().any(|row| !row.problems.is_empty());
    let (style, verdict) = match (report.promises_kept, report.finished) {
        (true, _) => (TextStyle::Good, "Every promise was kept"),
        (false, false) if !is_broken => (TextStyle::Strong, "Not run to its end"),
        (false, _) => (TextStyle::Bad, "A promise was broken"),
    };
    let late = match report.late {
        0 => String::new(),
        late => format!(" ({late} that a row counts as lost came late)"),
    };
    let text = format!(
        "{verdict}: {} in {:.1} s, seed {}; reliable messages: {} lost{late}, {} doubled.",
        counted(rows, "fault"),
        report.took.as_secs_f64(),
        report.seed,
        sum.lost,
        sum.doubled
    );
    let lines = wrapped(&text, columns.clamp(NARROWEST, WIDE));
    lines.into_iter().map(|line| StyledLine::of(style, line)).collect()
}

fn name(row: &FaultRow) -> String {
    match &row.named {
        Some(named) => format!("{} {}", named.code, named.text),
        None => "-".into(),
    }
}

fn perished(row: &FaultRow) -> String {
    if row.perished == 0 { String::new() } else { format!("{} p ", row.perished) }
}

fn count_ink(count: u64) -> TextStyle {
    if count == 0 { TextStyle::Plain } else { TextStyle::Bad }
}

/// Milliseconds, with as many places as say something.
fn figure(span: Option<Duration>) -> String {
    let Some(span) = span else { return "-".into() };
    match millis(span) {
        millis if millis >= 100.0 => format!("{millis:.0}"),
        millis if millis >= 10.0 => format!("{millis:.1}"),
        millis => format!("{millis:.3}"),
    }
}

fn wrapped(text: &str, columns: usize) -> Vec<String> {
    let mut lines = vec![String::new()];
    for word in text.split(' ') {
        let last = lines.last_mut().expect("there is always a line");
        if last.chars().count() + 1 + word.chars().count() > columns && !last.is_empty() {
            lines.push(format!("   {word}"));
        } else {
            if !last.is_empty() {
                last.push(' ');
            }
            last.push_str(word);
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::flow_accounting::FlowLosses;
    use crate::demo::report::{NOTES, ReportedFault, paper_figure};
    use crate::demo::robot::Module;
    use crate::demo::robot_state::Measured;
    use crate::demo::text_style::Palette;
    use crate::demo::timings::Timings;
    use crate::golden;

    fn row(number: u32, fault: &'static str, place: &str, named: (&str, &str)) -> FaultRow {
        let (code, text) = named;
        FaultRow {
            number,
            fault,
            place: place.into(),
            named: Some(ReportedFault {
                code: code.into(),
                text: text.into(),
                place: place.into(),
                detail: String::new(),
            }),
            detected_after: Some(Duration::from_nanos(21_400)),
            recovered_after: Some(Duration::from_micros(65)),
            from_repair: false,
            lost: 0,
            doubled: 0,
            perished: 0,
            paper: paper_figure(fault),
            problems: vec![],
        }
    }

    pub(crate) fn report() -> Report {
        let mut rows = vec![
            row(1, "panic", "module1:skin/17", ("B01", "panic")),
            row(2, "cable cut", "module1 -ethernet- module2", ("B11", "link down")),
            row(3, "both cables cut, return", "module1 - module2", ("B13", "node lost")),
            row(4, "kill -9, rejoin", "module3", ("B13", "node lost")),
        ];
        rows[2].from_repair = true;
        rows[3].recovered_after = None;
        rows[3].lost = 2;
        rows[3].perished = 14;
        rows[3].problems = vec!["service is not back".into(), "2 messages were lost".into()];
        let mut timings = Timings::default();
        for micros in [40, 55, 1_200] {
            timings.record(Duration::from_micros(micros));
        }
        let pairs = [(Module::Module1, Module::Module2), (Module::Module2, Module::Module3)];
        let measured = Measured {
            responses: pairs.map(|pair| (pair, timings.clone())).into(),
            unfiltered: timings,
            ..Measured::default()
        };
        let mut report = Report {
            promises_kept: false,
            finished: true,
            seed: 1,
            chaos: false,
            took: Duration::from_millis(21_345),
            rows,
            rows_left_out: 3,
            problems: vec!["module2 named hang in module2:laser, where nothing was done".into()],
            messages: FlowLosses { lost: 2, doubled: 0, perished: 14 },
            late: 0,
            received: 9_000,
            given_back: 5,
            responses: vec![],
            events: vec![],
            notes: NOTES.into(),
        };
        report.take_measured(&measured);
        report
    }

    fn text(columns: usize) -> String {
        draw(&report(), columns).iter().map(|line| line.paint(Palette::Plain) + "\n").collect()
    }

    #[test]
    fn the_table_stands_beside_the_papers_figures() {
        golden::check("table.txt", &text(140));
    }

    #[test]
    fn a_narrow_terminal_gets_a_paragraph_for_each_row() {
        golden::check("table_narrow.txt", &text(80));
    }

    #[test]
    fn the_document_holds_what_the_table_shows() {
        let mut document = serde_json::to_string_pretty(&report()).expect("plain data");
        document.push('\n');
        golden::check("report.json", &document);
    }

    #[test]
    fn a_figure_has_as_many_places_as_say_something() {
        let check = |nanos, wanted| assert_eq!(figure(Some(Duration::from_nanos(nanos))), wanted);
        check(0, "0.000");
        check(21_400, "0.021");
        check(9_999_000, "9.999");
        check(11_123_000, "11.1");
        check(1_234_567_000, "1235");
        assert_eq!(figure(None), "-");
    }
}

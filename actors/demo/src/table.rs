//! The tables at the end of a run, with the figures of the paper.

use crate::flow_account::FlowLosses;
use crate::report::{FaultRow, Report, counted, millis};
use comfy_table::{CellAlignment, ColumnConstraint, ContentArrangement, Table, presets};
use std::fmt::Write;
use std::time::Duration;

/// Text and tables are not wrapped to less.
const NARROWEST: u16 = 40;
/// Text is not wrapped to more.
const WIDEST: u16 = 124;

/// Returns the tables as text, wrapped to `columns` where their words permit it.
pub(crate) fn draw(report: &Report, columns: u16) -> String {
    let mut text = String::from("\n");
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{}", faults(report, columns).trim_fmt());
    for problem in problems(report) {
        text += &wrapped(&format!("! {problem}"), columns);
    }
    text.push('\n');
    let _ = writeln!(text, "{}\n", latencies(report, columns).trim_fmt());
    for note in &report.notes {
        text += &wrapped(note, columns);
    }
    text.push('\n');
    text + &wrapped(&verdict(report), columns)
}

fn faults(report: &Report, columns: u16) -> Table {
    let mut table = table(columns);
    table.set_header([
        "",
        "fault",
        "where",
        "found as",
        "found",
        "recovered",
        "lost",
        "doubled",
        "symptoms",
        "paper",
    ]);
    for column in [0, 4, 5, 6, 7, 8, 9] {
        right_aligned(&mut table, column);
    }
    table.add_rows(report.rows.iter().map(|row| {
        let recovered = figure(row.recovered_after);
        let FlowLosses { lost, doubled, perished, returned } = row.losses;
        let besides = [(perished, 'p'), (returned, 'd')].into_iter();
        let besides = besides.filter(|(count, _)| *count > 0);
        let besides: String = besides.map(|(count, mark)| format!("+{count}{mark} ")).collect();
        [
            row.number.to_string(),
            row.fault.title.to_owned(),
            row.location.clone(),
            row.named.as_ref().map_or("-".into(), |named| format!("{} {}", named.code, named.text)),
            figure(row.detected_after),
            if row.from_repair { format!("{recovered} r") } else { recovered },
            format!("{besides}{lost}"),
            doubled.to_string(),
            row.symptoms.to_string(),
            row.fault.paper.map(|(mark, figure)| format!("{figure} {mark}")).unwrap_or_default(),
        ]
    }));
    table
}

/// Everything that broke a promise, each with its fault.
fn problems(report: &Report) -> Vec<String> {
    let in_rows = report.rows.iter().flat_map(|row| {
        let FaultRow { number, fault, .. } = row;
        row.problems.iter().map(move |problem| format!("{number} {fault}: {problem}"))
    });
    in_rows.chain(report.problems.iter().cloned()).collect()
}

fn latencies(report: &Report, columns: u16) -> Table {
    let mut table = table(columns);
    table.set_header(["latency", "over", "times", "mean", "median", "99 %", "worst", "paper c"]);
    for column in 2..8 {
        right_aligned(&mut table, column);
    }
    table.add_rows(report.latencies.iter().map(|row| {
        let paper = row.paper_mean_ms.map(|mean| format!("{mean:.3}"));
        let what = [row.what.to_owned(), row.over.to_owned(), row.count.to_string()];
        what.into_iter().chain(row.figures.map(figure)).chain([paper.unwrap_or_default()])
    }));
    table
}

fn verdict(report: &Report) -> String {
    let sum = &report.messages;
    let is_broken =
        !report.problems.is_empty() || report.rows.iter().any(|row| !row.problems.is_empty());
    let verdict = match (report.promises_kept, report.finished) {
        (true, _) => "Every promise was kept",
        (false, false) if !is_broken => "The run was ended early",
        (false, _) => "A promise was broken",
    };
    let returned = match sum.returned {
        0 => String::new(),
        returned => format!(", {returned} returned as dead letters"),
    };
    let busy = match report.overloads {
        0 => String::new(),
        count => format!(
            " The computer was too busy for the robot: {} found where none was injected.",
            counted(count, "overload")
        ),
    };
    format!(
        "{verdict}: {} in {:.1} s; reliable messages: {} lost, {} doubled{returned}.{busy}",
        counted(report.rows.len() as u64, "fault"),
        report.took.as_secs_f64(),
        sum.lost,
        sum.doubled
    )
}

fn table(columns: u16) -> Table {
    let mut table = Table::new();
    table
        .load_style(presets::NOTHING)
        .set_content_arrangement(ContentArrangement::Dynamic)
        .set_width(columns.max(NARROWEST));
    table
}

fn right_aligned(table: &mut Table, column: usize) {
    if let Some(column) = table.column_mut(column) {
        column.set_cell_alignment(CellAlignment::Right);
        column.set_constraint(ColumnConstraint::ContentWidth);
    }
}

/// One paragraph, with the end of its last line.
fn wrapped(text: &str, columns: u16) -> String {
    let mut table = table(columns.min(WIDEST));
    table.add_row([text]);
    if let Some(column) = table.column_mut(0) {
        column.set_padding((0, 0));
    }
    table.trim_fmt() + "\n"
}

/// Milliseconds, with more decimals for smaller figures.
fn figure(span: Option<Duration>) -> String {
    let Some(span) = span else { return "-".into() };
    match millis(span) {
        millis if millis >= 100.0 => format!("{millis:.0}"),
        millis if millis >= 10.0 => format!("{millis:.1}"),
        millis => format!("{millis:.3}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::faults::{Blow, FAULTS};
    use crate::golden;
    use crate::messages::UNFILTERED;
    use crate::report::{ReportedFault, latencies as figures};

    fn row(title: &str) -> FaultRow {
        let found = FAULTS.iter().enumerate().find(|(_, fault)| fault.title == title);
        let (at, fault) = found.expect("there is such a fault");
        FaultRow {
            number: at as u32 + 1,
            fault,
            location: fault.place(),
            named: Some(ReportedFault {
                code: fault.kind.code().into(),
                text: fault.kind.text().into(),
                location: fault.place(),
                detail: String::new(),
            }),
            detected_after: Some(Duration::from_nanos(21_400)),
            recovered_after: Some(Duration::from_micros(65)),
            from_repair: fault.blow == Blow::Blackout,
            losses: FlowLosses::default(),
            symptoms: 0,
            problems: vec![],
        }
    }

    fn report() -> Report {
        let titles = ["panic", "cable cut", "both cables cut, return", "kill -9, rejoin"];
        let mut rows: Vec<_> = titles.into_iter().map(row).collect();
        rows[2].losses.returned = 240;
        rows[3].recovered_after = None;
        rows[3].losses.lost = 2;
        rows[3].losses.perished = 14;
        rows[3].symptoms = 15;
        rows[3].problems = vec!["service is not back".into(), "2 messages were lost".into()];
        let nanos = vec![40_000, 55_000, 1_200_000];
        let names = ["ask/1-2", "ask/2-3", UNFILTERED];
        Report {
            promises_kept: false,
            finished: true,
            took: Duration::from_millis(21_345),
            rows,
            problems: vec!["module2 named hang in module2:laser, where nothing was done".into()],
            messages: FlowLosses { lost: 2, doubled: 0, perished: 14, returned: 240 },
            received: 9_000,
            overloads: 3,
            latencies: figures(&names.map(|name| (name.to_owned(), nanos.clone())).into()),
            notes: vec![],
        }
        .with_notes()
    }

    #[test]
    fn the_tables_state_each_fault_and_the_papers_figures() {
        golden::check("table.txt", &draw(&report(), 140));
    }

    #[test]
    fn a_narrow_terminal_gets_wrapped_tables() {
        golden::check("table_narrow.txt", &draw(&report(), 80));
    }

    #[test]
    fn the_document_holds_what_the_table_shows() {
        let mut document = serde_json::to_string_pretty(&report()).expect("plain data");
        document.push('\n');
        golden::check("report.json", &document);
    }

    #[test]
    fn every_note_belongs_to_a_row() {
        let mut report = report();
        let all = report.notes.len();
        report.rows.truncate(1);

        let marks: Vec<_> = report.with_notes().notes.iter().map(|note| &note[..1]).collect();
        assert_eq!((all, marks), (7, vec!["A", "a", "c"]));
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

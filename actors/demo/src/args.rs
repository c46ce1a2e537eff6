//! Parses the command line.

use clap::{Args, Parser, Subcommand};
use std::path::PathBuf;
use std::time::Duration;

/// The longest `--for`.
const LONGEST: Duration = Duration::from_secs(24 * 60 * 60);
/// The shortest `--for`: less than one step of the scenario.
const SHORTEST: Duration = Duration::from_secs(1);

const EXIT_STATUS: &str = "\
Exit status:
  0  every fault was found, located and recovered, and no reliable message was lost or doubled
  1  a fault was not recovered, or another promise was broken; the table states which
  2  the command line was wrong, or the demonstration could not be run to its end";

/// Start a robot of three processes, kill, hang and unplug parts of it, and show how it recovers
///
/// Three processes, module1 to module3, run a service robot with a hundred small objects. Two
/// networks on loopback addresses and free ports connect them, sealed with keys that are made
/// for this run. Ten faults are injected one after the other while numbered messages are sent.
/// A terminal shows a live view, any other output gets one line for each step; tables follow at
/// the end. It takes less than 30 seconds. Ctrl-C ends all processes.
#[derive(Debug, Parser)]
#[command(name = "blastema-demo", version, args_conflicts_with_subcommands = true, after_help = EXIT_STATUS)]
pub(crate) struct DemoArguments {
    /// What the demonstration starts.
    #[command(subcommand)]
    pub(crate) part: Option<DemoPart>,
    /// The options of the demonstration.
    #[command(flatten)]
    pub(crate) demo: DemoOptions,
}

/// A part of the demonstration that runs in a process of its own.
#[derive(Clone, Debug, PartialEq, Subcommand)]
pub(crate) enum DemoPart {
    /// Run one module of the demonstration's robot; started by the demonstration itself
    #[command(hide = true)]
    Module(ModuleOptions),
}

/// The options of the demonstration.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct DemoOptions {
    /// Print one JSON document at the end, and nothing else
    #[arg(long)]
    pub(crate) json: bool,
    /// Seed of the times, and with --chaos of the places and kinds, of the injected faults
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub(crate) seed: u64,
    /// Run for this long, 1s to 24h, such as 60s, 5m, 1h or 1500ms: the scenario is repeated, and
    /// its last step is finished. Default: the scenario once, or 60s of chaos
    #[arg(long = "for", value_name = "DURATION", value_parser = parse_duration)]
    pub(crate) length: Option<Duration>,
    /// Inject random faults until the time has passed, instead of the scenario
    #[arg(long)]
    pub(crate) chaos: bool,
}

/// The options with which the demonstration starts one module.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct ModuleOptions {
    /// The module's name
    #[arg(long)]
    pub(crate) name: String,
    /// The Unix socket on which the demonstration listens
    #[arg(long)]
    pub(crate) control: PathBuf,
    /// The process with which this one ends
    #[arg(long)]
    pub(crate) parent: u32,
    /// The file of the module's key, with the roster beside it
    #[arg(long, value_name = "FILE")]
    pub(crate) keys: PathBuf,
}

fn parse_duration(text: &str) -> Result<Duration, String> {
    match parse_span(text)? {
        span if (SHORTEST..=LONGEST).contains(&span) => Ok(span),
        _ => Err(format!("{text} is not between 1s and 24h")),
    }
}

fn parse_span(text: &str) -> Result<Duration, String> {
    let digits = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let millis_of_unit = match unit {
        "ms" => 1,
        "s" => 1_000,
        "m" | "min" => 60_000,
        "h" => 3_600_000,
        "" => return Err(format!("a duration needs its unit: did you mean {text}s?")),
        other => return Err(format!("{other:?} is no unit; write 1500ms, 60s, 5m or 1h")),
    };
    if number.is_empty() {
        return Err(format!("{text:?} does not begin with a whole number"));
    }
    // A number that does not fit is too long, as is the largest one.
    let number: u64 = number.parse().unwrap_or(u64::MAX);
    Ok(Duration::from_millis(number.saturating_mul(millis_of_unit)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    fn parse(line: &str) -> Result<DemoOptions, String> {
        DemoArguments::try_parse_from(line.split_whitespace())
            .map(|arguments| arguments.demo)
            .map_err(|error| error.to_string())
    }

    #[test]
    fn the_definition_holds_together() {
        DemoArguments::command().debug_assert();
    }

    #[test]
    fn every_option_is_understood() {
        let usual = DemoOptions { json: false, seed: 1, length: None, chaos: false };
        assert_eq!(parse("blastema-demo"), Ok(usual));
        let length = Some(Duration::from_secs(60));
        let wanted = DemoOptions { json: true, seed: 42, length, chaos: true };
        assert_eq!(parse("blastema-demo --json --seed 42 --for 60s --chaos"), Ok(wanted));
    }

    #[test]
    fn a_duration_takes_its_unit_and_nothing_else() {
        let check = |text, millis| {
            assert_eq!(parse_duration(text), Ok(Duration::from_millis(millis)), "{text}");
        };
        check("1500ms", 1_500);
        check("60s", 60_000);
        check("2m", 120_000);
        check("24h", 86_400_000);

        for (text, told) in [
            ("60", "did you mean 60s?"),
            ("s", "does not begin with a whole number"),
            ("-5s", "is no unit"),
            ("1.5s", "is no unit"),
            ("5 s", "is no unit"),
            ("10ms", "is not between"),
            ("25h", "is not between"),
            ("99999999999999999999s", "is not between 1s and 24h"),
            ("9999999999999999999h", "is not between"),
        ] {
            let refusal = parse_duration(text).expect_err(text);
            assert!(refusal.contains(told), "{text}: {refusal}");
        }
    }

    #[test]
    fn what_is_unknown_is_refused_with_the_nearest_right_spelling() {
        let refusal = parse("blastema-demo --sed 4").expect_err("an unknown flag");

        assert!(refusal.contains("--seed"), "{refusal}");
        assert!(parse("blastema-demo dance").is_err());
    }

    #[test]
    fn the_help_tells_the_exit_status_and_hides_the_module() {
        let help = DemoArguments::command().render_long_help().to_string();
        assert!(!help.contains("module  "), "{help}");
        for part in
            ["--json", "--seed <N>", "--for <DURATION>", "1s to 24h", "--chaos", "Exit status"]
        {
            assert!(help.contains(part), "{part} is missing in {help}");
        }
    }
}

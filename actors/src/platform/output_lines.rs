//! The output of another process as lines: bounded in length and in number.

use super::{now, timer_at};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncRead, BufReader};
use tokio::time::sleep_until;

/// A longer line is cut.
const LINE_MAX: usize = 16 * 1024;
/// More lines in one second than a person or a disk takes are counted instead.
const LINES_MAX: u64 = 1000;
const SECOND: Duration = Duration::from_secs(1);

/// Passes on each line until the output ends.
///
/// Of a line of more than 16 KiB the rest is cut, with a mark. Of more than 1,000 lines in a second
/// the rest is dropped, and one line says how many. The process that writes is not held up.
pub async fn read_lines(output: impl AsyncRead + Unpin, mut pass: impl FnMut(&str)) {
    let mut output = BufReader::new(output);
    let (mut line, mut cut) = (Vec::new(), 0);
    let (mut second_ends, mut passed) = (now(), 0);
    loop {
        let bytes = tokio::select! {
            bytes = output.fill_buf() => bytes.unwrap_or_default(),
            () = sleep_until(timer_at(second_ends)), if passed > LINES_MAX => {
                pass(&left_out(passed));
                passed = 0;
                continue;
            }
        };
        let (is_over, end) = (bytes.is_empty(), bytes.iter().position(|byte| *byte == b'\n'));
        let taken = end.unwrap_or(bytes.len());
        let kept = taken.min(LINE_MAX - line.len());
        line.extend_from_slice(&bytes[..kept]);
        cut += taken - kept;
        output.consume(taken + usize::from(end.is_some()));
        if end.is_some() || is_over && !line.is_empty() {
            if now() >= second_ends {
                if passed > LINES_MAX {
                    pass(&left_out(passed));
                }
                (second_ends, passed) = (now() + SECOND, 0);
            }
            passed += 1;
            if passed <= LINES_MAX {
                let text = String::from_utf8_lossy(&line);
                let mark = if cut > 0 { format!("… ({cut} bytes more)") } else { String::new() };
                pass(&format!("{}{mark}", text.trim_end()));
            }
            line.clear();
            cut = 0;
        }
        if is_over {
            if passed > LINES_MAX {
                pass(&left_out(passed));
            }
            return;
        }
    }
}

fn left_out(written: u64) -> String {
    format!("({} more lines were written within a second, and are left out)", written - LINES_MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_doubles::{advance, paused};
    use std::cell::RefCell;
    use tokio::io::AsyncWriteExt;

    #[test]
    fn a_flood_is_counted_a_long_line_is_cut_and_the_last_line_needs_no_end() {
        let passed = RefCell::new(Vec::new());
        paused(async {
            let (mut writer, reader) = tokio::io::duplex(1 << 16);
            let write = async move {
                for number in 0..5000 {
                    writer.write_all(format!("line {number}\n").as_bytes()).await.unwrap();
                }
                advance(SECOND).await;
                writer.write_all("ä".repeat(LINE_MAX).as_bytes()).await.unwrap();
                writer.write_all(b"\nthe \xff end").await.unwrap();
            };
            tokio::join!(
                write,
                read_lines(reader, |line| passed.borrow_mut().push(line.to_owned()))
            );
        });

        let passed = passed.into_inner();
        assert_eq!(passed.len(), 1003, "{:?}", passed.last());
        assert_eq!((passed[0].as_str(), passed[999].as_str()), ("line 0", "line 999"));
        let flood = "(4000 more lines were written within a second, and are left out)";
        assert_eq!(passed[1000], flood);
        let cut = format!("{}… (16384 bytes more)", "ä".repeat(LINE_MAX / 2));
        assert!(passed[1001] == cut, "{} bytes", passed[1001].len());
        assert_eq!(passed[1002], "the \u{fffd} end");
    }
}

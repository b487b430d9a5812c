//! Results on stdout.

use std::io::{ErrorKind, Result, Write};

/// Prints lines. That nobody reads them to the end (`| head -1`) is no failure.
pub fn print(lines: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{lines}").and_then(|()| out.flush()) {
        Err(e) if e.kind() == ErrorKind::BrokenPipe => Ok(()),
        written => written,
    }
}

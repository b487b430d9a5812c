//! Reading a generated answer: from words to metres, or to nothing.
//!
//! What counts is written down as a small grammar, and the whole text has to follow it: an answer that says anything
//! else is no answer. Nothing is guessed, since a wrong depth is worse than a missing one.

use super::template::{ANSWER, PromptTemplate, SUPERVISION};
use super::unit::split_unit;
use crate::depth::SparseDepth;
use std::ops::Range;

/// Digits before the point, at most: [`SparseDepth::MAX_DEPTH`] in millimetres has eight.
const MAX_INTEGERS: usize = 8;
/// Digits after the point, at most.
const MAX_DECIMALS: usize = 9;

/// Why a text is no depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unreadable {
    /// It is not one of the known sentences around one plain decimal number.
    Words,
    /// Its number has no unit, and the template does not answer without one.
    NoUnit,
    /// Its number is no depth: zero, above [`SparseDepth::MAX_DEPTH`] or with more digits than any depth has.
    OutOfRange,
}

impl std::fmt::Display for Unreadable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Words => "not an answer sentence around one decimal number",
            Self::NoUnit => "a number without its unit",
            Self::OutOfRange => "a number that is no depth",
        })
    }
}

/// A depth that was read from a text.
#[derive(Debug, Clone, PartialEq)]
pub struct ParsedDepth {
    /// Metres; finite, above 0.
    pub metres: f32,
    /// The number as it stands in the text, in bytes.
    pub number: Range<usize>,
}

/// The answers that a checkpoint may give.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerGrammar {
    /// Words before and after the number.
    sentences: Vec<(String, String)>,
    /// Metres of a number without a unit, where the template answers with such.
    unnamed: Option<f64>,
}

/// Reads a depth in metres from one of the published answers: the paper's two sentences (Sec. 3.3 and 3.4), DepthLM's
/// `<answer> x </answer>` (metres; it may follow a `<think>` part), or a number with its unit.
///
/// A number is written as digits with at most one point between them; its unit is m, cm or mm, or meter, metre, centimeter,
/// millimetre and so on.
///
/// # Errors
/// What is wrong with the text.
///
/// ```
/// use sdim::internals::query::parse_depth;
/// assert_eq!(parse_depth("The current pixel is 3.2 meters away from the camera."), Ok(3.2));
/// assert_eq!(parse_depth("<think> Near. </think> <answer> 0.85 </answer>"), Ok(0.85));
/// assert_eq!(parse_depth("850 mm"), Ok(0.85));
/// assert!(parse_depth("between 3 and 4 meters").is_err());
/// ```
pub fn parse_depth(text: &str) -> Result<f32, Unreadable> {
    let published = AnswerGrammar { sentences: sentences(&[ANSWER, SUPERVISION, "{y}"]), unnamed: None };
    published.parse(text).map(|p| p.metres)
}

fn sentences(with_y: &[&str]) -> Vec<(String, String)> {
    let around = with_y.iter().filter_map(|s| s.split_once("{y}"));
    around
        .map(|(before, after)| {
            // The unit is read with the number, a last point may be missing.
            let after = split_unit(after).map_or(after, |(_, rest)| rest);
            (before.to_string(), after.trim_end().trim_end_matches('.').to_string())
        })
        .collect()
}

impl AnswerGrammar {
    /// The published answers, and the template's own sentence. A number without a unit counts `unit` metres if the
    /// template's own sentence names none.
    pub fn new(template: &PromptTemplate, unit: f32) -> Self {
        Self {
            sentences: sentences(&[&template.answer, ANSWER, SUPERVISION, "{y}"]),
            unnamed: template.answer_unit().is_none().then_some(f64::from(unit)),
        }
    }

    /// Reads a depth from a text; see [`parse_depth`].
    ///
    /// # Errors
    /// What is wrong with the text.
    pub fn parse(&self, text: &str) -> Result<ParsedDepth, Unreadable> {
        if text.contains("<answer>") || text.contains("</answer>") {
            return self.parse_tagged(text);
        }
        let mut why = Unreadable::Words;
        for (before, after) in &self.sentences {
            match quantity(text, before, after, self.unnamed) {
                Err(Unreadable::Words) => {}
                Err(other) => why = other,
                read => return read,
            }
        }
        Err(why)
    }

    fn parse_tagged(&self, text: &str) -> Result<ParsedDepth, Unreadable> {
        let (before, rest) = text.split_once("<answer>").ok_or(Unreadable::Words)?;
        let (content, after) = rest.split_once("</answer>").ok_or(Unreadable::Words)?;
        let before = before.trim_ascii();
        let thought = before.is_empty()
            || before.strip_prefix("<think>").and_then(|t| t.strip_suffix("</think>")).is_some_and(|t| {
                // One thought, or what looks like the answer may be part of another.
                !t.contains("<think>") && !t.contains("</think>")
            });
        if !thought || !after.trim_ascii().is_empty() || content.contains("<answer>") {
            return Err(Unreadable::Words);
        }
        let mut parsed = quantity(content, "", "", Some(self.unnamed.unwrap_or(1.0)))?;
        let start = text.len() - rest.len();
        parsed.number = start + parsed.number.start..start + parsed.number.end;
        Ok(parsed)
    }
}

/// `before`, a number with its unit, `after`, and nothing else. White space between words does not matter, nor does case,
/// nor a point at the end.
fn quantity(text: &str, before: &str, after: &str, unnamed: Option<f64>) -> Result<ParsedDepth, Unreadable> {
    let rest = skip_words(text, before).ok_or(Unreadable::Words)?;
    let digits = |s: &str| s.bytes().take_while(u8::is_ascii_digit).count();
    let integers = digits(rest);
    let decimals = rest[integers..].strip_prefix('.').map_or(0, digits);
    let length = integers + if decimals > 0 { 1 + decimals } else { 0 };
    let (number, rest) = rest.split_at(length);
    if integers == 0 || (integers > 1 && number.starts_with('0')) {
        return Err(Unreadable::Words);
    }
    let (named, rest) = match split_unit(rest) {
        Some((metres, rest)) => (Some(metres), rest),
        None => (None, rest),
    };
    let rest = skip_words(rest, after).ok_or(Unreadable::Words)?;
    // A point right after bare digits would be a decimal point whose decimals are missing.
    let whole = named.is_some() || !after.is_empty();
    let rest = if whole { rest.strip_prefix('.').unwrap_or(rest) } else { rest };
    if !rest.trim_ascii().is_empty() {
        return Err(Unreadable::Words);
    }
    let per_unit = named.or(unnamed).ok_or(Unreadable::NoUnit)?;
    if integers > MAX_INTEGERS || decimals > MAX_DECIMALS {
        return Err(Unreadable::OutOfRange);
    }
    let metres = number.parse::<f64>().map_err(|_| Unreadable::Words)? * per_unit;
    // 850 * 0.001 is not 0.85 in f64, but rounds to it in f32.
    let metres = metres as f32;
    if !(metres > 0.0 && metres <= SparseDepth::MAX_DEPTH) {
        return Err(Unreadable::OutOfRange);
    }
    let start = number.as_ptr() as usize - text.as_ptr() as usize;
    Ok(ParsedDepth { metres, number: start..start + length })
}

/// The text after these words, white space before each of them and after the last one left out.
fn skip_words<'a>(text: &'a str, words: &str) -> Option<&'a str> {
    let mut rest = text.trim_ascii_start();
    for word in words.split_ascii_whitespace() {
        let head = rest.get(..word.len())?;
        if !head.eq_ignore_ascii_case(word) {
            return None;
        }
        rest = rest[word.len()..].trim_ascii_start();
    }
    Some(rest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_published_answers_are_read() {
        for (text, metres) in [
            ("The current pixel is 3.2 meters away from the camera.", 3.2),
            ("The current pixel is 4.230 meters away from the camera.", 4.23),
            ("The pixel is 5.20 meters away from the camera.", 5.2),
            ("  the pixel is 12 metres away\nfrom the camera \n", 12.0),
            ("The current pixel is 320cm away from the camera.", 3.2),
            ("<answer> 3.20 </answer>", 3.2),
            ("<answer>3.2 m</answer>\n", 3.2),
            (
                "<think> The point is around 9.99 meters away from the camera. </think><answer> 3.20 </answer>",
                3.2,
            ),
            ("<think>\u{663c}, 1e9 or so</think>\n<answer> 45 centimetres. </answer>", 0.45),
            ("3.2 m", 3.2),
            ("3.2 Meters.", 3.2),
            ("850 mm", 0.85),
            ("850 Millimeters", 0.85),
            ("0.004 m", 0.004),
            ("10000 m", 10_000.0),
            ("10000000 mm", 10_000.0),
        ] {
            assert_eq!(parse_depth(text), Ok(metres), "{text}");
        }
    }

    #[test]
    fn anything_else_is_no_depth() {
        use Unreadable::*;
        let huge = "9".repeat(100_000);
        for (text, why) in [
            ("", Words),
            ("I cannot tell.", Words),
            ("The current pixel is inf meters away from the camera.", Words),
            ("The current pixel is NaN meters away from the camera.", Words),
            ("The current pixel is -3.2 meters away from the camera.", Words),
            ("The current pixel is +3.2 meters away from the camera.", Words),
            ("The current pixel is 3e2 meters away from the camera.", Words),
            ("The current pixel is 3.2 meters", Words),
            ("The current pixel is 3.2 meters away from the camera. It is a wall.", Words),
            ("The current pixel is 3.2 or 4.1 meters away from the camera.", Words),
            ("The current pixel is 3.2 feet away from the camera.", Words),
            ("The current pixel is 3.2 away from the camera.", NoUnit),
            ("3 meters 20", Words),
            ("3 4 meters", Words),
            ("3,200 mm", Words),
            ("3.2.1 m", Words),
            (".5 m", Words),
            ("3. m", Words),
            ("3.", Words),
            ("003 m", Words),
            ("0x10 m", Words),
            ("3 m\u{b2}", Words),
            ("3 m2", Words),
            ("3 MM", Words),
            ("3 Mm", Words),
            ("3.2 mmm", Words),
            ("\u{663}.\u{662} m", Words),
            ("\u{ff13} m", Words),
            ("3\u{a0}m", Words),
            ("3\u{2009}m", Words),
            ("\u{2212}3 m", Words),
            ("3.2", NoUnit),
            ("0 m", OutOfRange),
            ("0.000 meters", OutOfRange),
            ("0.0000000001 m", OutOfRange),
            ("10000.1 m", OutOfRange),
            ("99999999 m", OutOfRange),
            (&format!("{huge} m"), OutOfRange),
            (&format!("0.{huge} m"), OutOfRange),
            (&format!("The pixel is {huge}.{huge} meters away from the camera."), OutOfRange),
            ("<answer> 3.2", Words),
            ("3.2 </answer>", Words),
            ("<answer></answer>", Words),
            ("<answer> about 3.2 </answer>", Words),
            ("<answer> 3.2 </answer> <answer> 4 </answer>", Words),
            ("<answer> <answer> 3.2 </answer>", Words),
            ("<answer> 3.2 </answer> or 4", Words),
            ("4 meters <answer> 3.2 </answer>", Words),
            ("<think> a </think> b <think> c </think> <answer> 3.2 </answer>", Words),
            ("</answer> 3.2 <answer>", Words),
            ("<answer> -1 </answer>", Words),
            ("<answer> 1e-3 </answer>", Words),
            ("<answer> inf </answer>", Words),
            ("<answer> 3. </answer>", Words),
            ("<answer> 0 </answer>", OutOfRange),
        ] {
            let shown: String = text.chars().take(80).collect();
            assert_eq!(parse_depth(text), Err(why), "{shown}");
        }
    }

    #[test]
    fn a_template_decides_on_numbers_without_a_unit_and_adds_its_own_sentence() {
        let paper = AnswerGrammar::new(&PromptTemplate::paper(), 2.0);
        assert_eq!(paper.parse("0.5"), Err(Unreadable::NoUnit));
        let tiny = AnswerGrammar::new(&PromptTemplate::tiny(), 2.0);
        assert_eq!(tiny.parse("0.5").map(|p| p.metres), Ok(1.0), "half a unit of two metres");
        assert_eq!(tiny.parse(" 0.5 m").map(|p| p.metres), Ok(0.5));
        assert_eq!(tiny.parse("<answer> 0.5 </answer>").map(|p| p.metres), Ok(1.0));
        let own = PromptTemplate { answer: "d = {y} cm, I think".into(), ..PromptTemplate::paper() };
        let own = AnswerGrammar::new(&own, 0.01);
        let parsed = own.parse("d = 45 cm, I think").unwrap();
        assert_eq!((parsed.metres, parsed.number), (0.45, 4..6));
        assert_eq!(own.parse("d = 45, I think"), Err(Unreadable::NoUnit));
    }

    #[test]
    fn the_number_is_found_where_it_stands() {
        let text = "<think> 3.20 </think> <answer> 3.20 </answer>";
        let parsed = AnswerGrammar::new(&PromptTemplate::depthlm(), 1.0).parse(text).unwrap();
        assert_eq!(parsed.number, 31..35);
        assert_eq!(&text[parsed.number], "3.20");
    }
}

//! Free answers: greedy generation of many queries at once, and what can be read from them.

use super::batch::Batch;
use super::sdim_model::SdimModel;
use crate::depth::pixels::CONFIDENT_WITHIN;
use crate::error::{Error, Result};
use crate::query::grammar::AnswerGrammar;
use crate::query::mode::Generation;
use crate::query::number::NumberFormat;
use crate::query::reading::Reading;
use crate::vlm::chat::tokenizer::Tokenizer;
use candle_core::{DType, Device, Tensor};
use candle_transformers::utils::apply_repeat_penalty;
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;

/// Logits that are looked at in one piece, at most: 64 MiB in f32.
const LOGITS_PER_PASS: usize = 1 << 24;

/// What the model said to one query.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FreeAnswer {
    /// Token ids, without the one that ended it.
    pub ids: Vec<u32>,
    /// The probability of each of them among all tokens, after what stood before it.
    pub probabilities: Vec<f32>,
    /// Whether the model ended it itself; if not, it was cut off.
    pub ended: bool,
    /// For each token, the probabilities of the ten digits in its place.
    digits: Vec<[f32; 10]>,
}

/// How to choose the next token.
pub(super) struct TokenChooser<'a> {
    generation: &'a Generation,
    stop: Vec<u32>,
    /// Ids from this one on have no token.
    usable: usize,
    digits: [u32; 10],
}

/// A chosen token.
struct Choice {
    id: u32,
    probability: f32,
    digits: [f32; 10],
}

impl<'a> TokenChooser<'a> {
    pub(super) fn new(model: &SdimModel, generation: &'a Generation) -> Result<Self> {
        let numbers = model.prompts.numbers();
        let digits = match numbers.format {
            NumberFormat::Digits { .. } => numbers.ids.first_chunk().copied(),
            NumberFormat::Bins { .. } | NumberFormat::LogBins { .. } => None,
        };
        let Some(digits) = digits else {
            return Err(Error::argument("answer mode", "generate", "a checkpoint that writes digits"));
        };
        let stop = match &generation.stop {
            Some(tokens) => tokens.iter().map(|t| model.tokenizer.id(t)).collect::<Result<_>>()?,
            None => model.stop_ids.clone(),
        };
        Ok(Self { generation, stop, usable: model.tokenizer.vocab_size(), digits })
    }

    /// Answers of all items of a batch, each until it ends itself or has its most tokens.
    pub(super) fn answer_freely(&self, batch: &mut Batch) -> Result<Vec<FreeAnswer>> {
        let mut alive: Vec<usize> = (0..batch.sequences.count()).collect();
        let mut out = vec![FreeAnswer::default(); alive.len()];
        loop {
            let choices = self.choose(batch, &alive, &out)?;
            let (mut ids, mut keep) = (Vec::new(), Vec::new());
            for (row, choice) in choices.into_iter().enumerate() {
                let spoken = &mut out[alive[row]];
                // Logits that are no numbers leave the answer as it is: cut off.
                let Some(choice) = choice else { continue };
                if self.stop.contains(&choice.id) {
                    spoken.ended = true;
                    continue;
                }
                spoken.ids.push(choice.id);
                spoken.probabilities.push(choice.probability);
                spoken.digits.push(choice.digits);
                if spoken.ids.len() < self.generation.max_new_tokens {
                    ids.push(choice.id);
                    keep.push(row);
                }
            }
            if keep.is_empty() {
                return Ok(out);
            }
            if keep.len() < alive.len() {
                batch.keep(&keep)?;
                alive = keep.into_iter().map(|row| alive[row]).collect();
            }
            batch.sequences.decode_step(&ids)?;
        }
    }

    fn choose(&self, batch: &Batch, alive: &[usize], out: &[FreeAnswer]) -> Result<Vec<Option<Choice>>> {
        let decoder = &batch.model.vlm.decoder;
        let vocab = decoder.config().vocab_size;
        let mut choices = Vec::with_capacity(alive.len());
        let rows = (LOGITS_PER_PASS / vocab).max(1);
        for first in (0..alive.len()).step_by(rows) {
            let count = rows.min(alive.len() - first);
            let logits =
                decoder.logits(&batch.sequences.last().narrow(0, first, count)?)?.to_dtype(DType::F32)?;
            let logits: Vec<f32> = logits.flatten_all()?.to_vec1()?;
            let chosen = logits.par_chunks(vocab).enumerate().map(|(row, logits)| {
                let row = first + row;
                let said = out[alive[row]].ids.iter().copied();
                let penalised = self.penalised(logits, || batch.prompt(row).chain(said).collect())?;
                Ok(self.likeliest(&penalised[..self.usable.min(vocab)]))
            });
            choices.extend(chosen.collect::<Result<Vec<_>>>()?);
        }
        Ok(choices)
    }

    /// Logits in which the tokens seen so far are less likely, as the reference's generation does.
    fn penalised<'l>(&self, logits: &'l [f32], seen: impl FnOnce() -> Vec<u32>) -> Result<Cow<'l, [f32]>> {
        let penalty = self.generation.repetition_penalty;
        if penalty == 1.0 {
            return Ok(Cow::Borrowed(logits));
        }
        let tensor = Tensor::from_slice(logits, logits.len(), &Device::Cpu)?;
        Ok(Cow::Owned(apply_repeat_penalty(&tensor, penalty, &seen())?.to_vec1()?))
    }

    /// The first of the likeliest tokens; `None` if the logits are not numbers.
    fn likeliest(&self, logits: &[f32]) -> Option<Choice> {
        let (id, max) = logits
            .iter()
            .enumerate()
            .fold((0, f32::NEG_INFINITY), |b, (i, &l)| if l > b.1 { (i, l) } else { b });
        if !max.is_finite() || logits.iter().any(|l| l.is_nan()) {
            return None;
        }
        let total: f32 = logits.iter().map(|l| (l - max).exp()).sum();
        let p = |id: u32| logits.get(id as usize).map_or(0.0, |l| (l - max).exp() / total);
        Some(Choice { id: id as u32, probability: 1.0 / total, digits: self.digits.map(p) })
    }
}

impl FreeAnswer {
    /// The answer in words, special tokens left out.
    ///
    /// # Errors
    /// [`crate::Error::Tokenizer`] if the ids cannot be decoded.
    pub fn text(&self, tokenizer: &Tokenizer) -> Result<String> {
        tokenizer.decode(&self.ids)
    }

    /// The depth that the answer states, in metres; [`Reading::INVALID`] if it states none.
    ///
    /// An answer that was cut off counts only if its sentence is over, since digits or a unit may be missing. The
    /// *confidence* is the product of the probabilities of the tokens that say the number: its digits and its point, but for
    /// digits at places worth at most 5 % of it. Words do not count, and a number that is said several times (as DepthLM
    /// does, thinking first) counts each time: what is copied is as sure as what it was copied from. The *expected error* adds
    /// up, over the digits, how far the other digits that might have stood there are away; of several times, the largest sum.
    ///
    /// # Errors
    /// [`crate::Error::Tokenizer`] if the ids cannot be decoded.
    pub fn reading(&self, grammar: &AnswerGrammar, tokenizer: &Tokenizer) -> Result<Reading> {
        let text = self.text(tokenizer)?;
        let over = self.ended || text.trim_ascii_end().ends_with(['.', '>']);
        let Some(parsed) = grammar.parse(&text).ok().filter(|_| over) else {
            return Ok(Reading::INVALID);
        };
        let number: f64 = text[parsed.number.clone()].parse().unwrap_or(f64::NAN);
        let spans = self.spans(&text, tokenizer)?;
        let (mut confidence, mut error) = (1f32, 0f32);
        for said in numbers(&text).filter(|r| text[r.clone()].parse() == Ok(number)) {
            let (p, off) = self.rate(&text, said, &spans, number);
            confidence *= p;
            error = error.max(off);
        }
        let metres = parsed.metres / number as f32;
        Ok(Reading { value: parsed.metres, confidence, expected_error: error * metres })
    }

    /// The bytes of the text that each token stands for.
    fn spans(&self, text: &str, tokenizer: &Tokenizer) -> Result<Vec<Range<usize>>> {
        let mut start = 0;
        (1..=self.ids.len())
            .map(|n| {
                // A character may be made of several tokens, so that only what is decoded together can be measured.
                let end = tokenizer.decode(&self.ids[..n])?.len().clamp(start, text.len());
                Ok(std::mem::replace(&mut start, end)..end)
            })
            .collect()
    }

    /// Probability and expected error, in the number's own unit, of a number at `place` in the text.
    fn rate(&self, text: &str, place: Range<usize>, spans: &[Range<usize>], number: f64) -> (f32, f32) {
        let bytes = text.as_bytes();
        let point = place.clone().find(|&i| bytes[i] == b'.').unwrap_or(place.end);
        // What one more at this digit is worth.
        let worth = |i: usize| 10f64.powi(point as i32 - i as i32 - i32::from(i < point));
        let (mut confidence, mut error) = (1f32, 0f32);
        for (k, span) in spans.iter().enumerate() {
            let own = span.start.max(place.start)..span.end.min(place.end);
            let Some(top) = own.clone().find(|&i| i != point) else {
                if !own.is_empty() {
                    confidence *= self.probabilities[k];
                }
                continue;
            };
            if own.contains(&point) || worth(top) > number * f64::from(CONFIDENT_WITHIN) {
                confidence *= self.probabilities[k];
            }
            let digit = usize::from(bytes[top] - b'0');
            let off: f32 = match span.len() {
                1 => (0..10).map(|d| self.digits[k][d] * d.abs_diff(digit) as f32).sum(),
                // A token of several characters: if it is wrong, then by one at its first digit at least.
                _ => 1.0 - self.probabilities[k],
            };
            error += off * worth(top) as f32;
        }
        (confidence, error)
    }
}

/// The decimal numbers in a text, in bytes.
fn numbers(text: &str) -> impl Iterator<Item = Range<usize>> + '_ {
    let bytes = text.as_bytes();
    let mut at = 0;
    std::iter::from_fn(move || {
        let run = |from: usize| bytes[from..].iter().take_while(|b| b.is_ascii_digit()).count();
        at += bytes[at..].iter().position(u8::is_ascii_digit)?;
        let start = at;
        at += run(at);
        if bytes.get(at) == Some(&b'.') && run(at + 1) > 0 {
            at += 1 + run(at + 1);
        }
        Some(start..at)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::Settings;
    use crate::query::template::PromptTemplate;
    use crate::supervise::init::FreshFiles;

    /// A text of single bytes, all of them sure but for those given.
    fn spoken(text: &str, unsure: &[(usize, f32)]) -> (FreeAnswer, Tokenizer) {
        let tokenizer = FreshFiles::tiny(&Settings::paper()).unwrap().parse().unwrap().tokenizer;
        let ids = tokenizer.encode(text).unwrap();
        let mut out =
            FreeAnswer { probabilities: vec![1.0; ids.len()], ended: true, ids, ..Default::default() };
        for (i, byte) in text.bytes().enumerate() {
            let p = unsure.iter().find(|u| u.0 == i).map_or(1.0, |u| u.1);
            out.probabilities[i] = p;
            let mut digits = [0.0; 10];
            if byte.is_ascii_digit() {
                let digit = usize::from(byte - b'0');
                digits[digit] = p;
                digits[(digit + 1) % 10] = 1.0 - p;
            }
            out.digits.push(digits);
        }
        (out, tokenizer)
    }

    fn read(text: &str, unsure: &[(usize, f32)]) -> Reading {
        let (spoken, tokenizer) = spoken(text, unsure);
        spoken.reading(&AnswerGrammar::new(&PromptTemplate::paper(), 1.0), &tokenizer).unwrap()
    }

    #[test]
    fn only_the_places_that_matter_count_against_the_confidence() {
        let text = "The pixel is 4.20 meters away from the camera.";
        assert_eq!(read(text, &[(0, 0.1), (8, 0.1), (20, 0.1)]).confidence, 1.0, "words");
        let r = read(text, &[(13, 0.5), (14, 0.8), (15, 0.25), (16, 0.1)]);
        assert!((r.value - 4.2).abs() < 1e-6);
        // 0.1 is under 5 % of 4.2, so is 0.01; 4 and the point count.
        assert!((r.confidence - 0.5 * 0.8).abs() < 1e-6, "{r:?}");
        assert!((r.expected_error - (0.5 + 0.075 + 0.009)).abs() < 1e-5, "{r:?}");
        let r = read("420 cm", &[(0, 0.5), (1, 0.5), (2, 0.5)]);
        assert!((r.confidence - 0.5).abs() < 1e-6, "ten centimetres are under 5 %: {r:?}");
        assert!((r.expected_error - 0.555).abs() < 1e-5, "in metres: {r:?}");
    }

    #[test]
    fn a_copied_number_is_as_sure_as_what_it_was_copied_from() {
        let thought = "<think> The point is around 4.2 meters away, not 9.9. </think><answer> 4.2 </answer>";
        let at = thought.find("4.2").unwrap();
        let other = thought.find("9.9").unwrap();
        let r = read(thought, &[(at, 0.25), (other, 0.5)]);
        assert!((r.confidence - 0.25).abs() < 1e-6 && (r.expected_error - 0.75).abs() < 1e-5, "{r:?}");
    }

    #[test]
    fn an_answer_that_was_cut_off_counts_only_if_its_sentence_is_over() {
        for (text, over) in [
            ("The pixel is 4.20 meters away from the camera.", true),
            ("<answer> 4.20 </answer>", true),
            ("4.2 m", false),
            ("The pixel is 4.20 meters away from the camera", false),
        ] {
            let (mut spoken, tokenizer) = spoken(text, &[]);
            let grammar = AnswerGrammar::new(&PromptTemplate::paper(), 1.0);
            assert!(spoken.reading(&grammar, &tokenizer).unwrap().value > 4.0, "{text}");
            spoken.ended = false;
            assert_eq!(spoken.reading(&grammar, &tokenizer).unwrap().value > 4.0, over, "{text}");
        }
    }

    #[test]
    fn nothing_readable_is_invalid() {
        let r = read("far away", &[]);
        assert!(r.value.is_nan() && r.expected_error.is_nan() && r.confidence == 0.0);
    }
}

//! Units as sentences name them.

/// Metres of a unit's name: abbreviations as they are written, words in any case.
fn metres_per(unit: &str) -> Option<f64> {
    match unit {
        "m" => return Some(1.0),
        "cm" => return Some(0.01),
        "mm" => return Some(0.001),
        _ => {}
    }
    match unit.to_ascii_lowercase().as_str() {
        "meter" | "meters" | "metre" | "metres" => Some(1.0),
        "centimeter" | "centimeters" | "centimetre" | "centimetres" => Some(0.01),
        "millimeter" | "millimeters" | "millimetre" | "millimetres" => Some(0.001),
        _ => None,
    }
}

/// Metres of the unit that a text starts with, and the text after it.
pub(crate) fn split_unit(text: &str) -> Option<(f64, &str)> {
    let text = text.trim_ascii_start();
    let letters = text.bytes().take_while(u8::is_ascii_alphabetic).count();
    let metres = metres_per(&text[..letters])?;
    // "3.2 m²" and "3 meters_squared" are no depths.
    let ends =
        text[letters..].chars().next().is_none_or(|c| c.is_ascii() && !c.is_alphanumeric() && c != '_');
    ends.then_some((metres, &text[letters..]))
}

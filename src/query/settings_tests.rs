use super::*;
use std::path::Path;

fn parse(text: &str) -> Result<Settings> {
    Settings::from_bytes(Path::new("dir/sdim.json"), text.as_bytes())
}

fn with(change: impl FnOnce(&mut Value), settings: Settings) -> Result<Settings> {
    let mut json = serde_json::to_value(settings).unwrap();
    change(&mut json);
    parse(&json.to_string())
}

#[test]
fn presets_round_trip_and_files_of_the_first_format_are_read_as_they_are() {
    for name in PromptTemplate::PRESETS {
        let settings = Settings::preset(name).unwrap();
        assert_eq!(settings.template, PromptTemplate::preset(name).unwrap());
        assert_eq!(with(|_| {}, settings.clone()).unwrap(), settings, "{name}");
        assert_eq!(parse(&format!("{{\"preset\": {name:?}}}")).unwrap(), settings, "{name}");
    }
    let shipped = include_str!("../../assets/sdim-tiny/sdim.json");
    let shipped = parse(shipped).unwrap();
    assert!(!shipped.confidence.is_identity(), "found for these weights; others start without");
    assert_eq!(Settings { confidence: ConfidenceScale::default(), ..shipped }, Settings::tiny());
    let old = with(|j| drop(j.as_object_mut().unwrap().remove("answer_mode")), Settings::paper());
    assert_eq!(old.unwrap(), Settings::paper());
}

#[test]
fn a_file_may_name_presets_and_change_them() {
    let settings = parse(
        r#"{"format": 1, "preset": "depthlm", "unit": "metres",
            "pixel_reference": {"kind": "marker", "shape": "cross", "size": 9},
            "answer_mode": {"kind": "generate", "max_new_tokens": 20}}"#,
    );
    let marker = Marker { shape: super::super::MarkerShape::Cross, size: 9, colour: [255, 0, 0] };
    let mode = AnswerMode::Generate(Generation { max_new_tokens: 20, ..Generation::default() });
    let want = Settings {
        pixel_reference: PixelReference::Marker(marker),
        answer_mode: mode,
        ..Settings::depthlm()
    };
    assert_eq!(settings.unwrap(), want);
    let named = with(|j| j["template"] = "paper".into(), Settings::paper());
    assert_eq!(named.unwrap(), Settings::paper());
    let both = parse(r#"{"preset": "depthlm", "template": "paper_marked"}"#).unwrap();
    assert_eq!(both.template, PromptTemplate::paper_marked());
}

#[test]
fn what_is_wrong_is_named() {
    type Change = fn(&mut Value);
    let cases: [(Settings, Change, &str); 23] = [
        (Settings::tiny(), |j| j["wide_glimpse"] = 0.into(), "wide_glimpse"),
        (Settings::tiny(), |j| j["glimpse"] = Value::Null, "wide_glimpse"),
        (Settings::tiny(), |j| j["hint"] = "none".into(), "wide_glimpse"),
        (Settings::paper(), |j| j["wide_glimpse"] = 64.into(), "wide_glimpse"),
        (
            Settings::tiny(),
            |j| j["confidence"] = serde_json::json!({"temperature": 0, "offset": 0}),
            "confidence",
        ),
        (
            Settings::tiny(),
            |j| j["confidence"] = serde_json::json!({"temperature": 1, "offset": 1e300}),
            "confidence",
        ),
        (Settings::tiny(), |j| j["number"]["lowest"] = 0.0.into(), "number.bins"),
        (Settings::tiny(), |j| j["number"]["lowest"] = 16.0.into(), "number.bins"),
        (Settings::tiny(), |j| j["number"]["highest"] = 1e300.into(), "number.bins"),
        (Settings::paper(), |j| j["template"] = "papers".into(), "template"),
        (Settings::paper(), |j| j["preset"] = "qwen".into(), "preset"),
        (Settings::paper(), |j| j["preset"] = 7.into(), "preset"),
        (Settings::depthlm(), |j| j["pixel_reference"]["size"] = 0.into(), "pixel_reference.size"),
        (Settings::depthlm(), |j| j["pixel_reference"]["size"] = 100_000.into(), "pixel_reference.size"),
        (Settings::depthlm(), |j| j["template"] = "paper".into(), "template.query"),
        (Settings::paper(), |j| j["template"] = "depthlm".into(), "template.query"),
        (
            Settings::depthlm(),
            |j| j["answer_mode"]["max_new_tokens"] = 0.into(),
            "answer_mode.max_new_tokens",
        ),
        (
            Settings::depthlm(),
            |j| j["answer_mode"]["max_new_tokens"] = 5000.into(),
            "answer_mode.max_new_tokens",
        ),
        (
            Settings::depthlm(),
            |j| j["answer_mode"]["repetition_penalty"] = (-1.0).into(),
            "answer_mode.repetition_penalty",
        ),
        (Settings::depthlm(), |j| j["answer_mode"]["stop"] = Value::Array(vec![]), "answer_mode.stop"),
        (Settings::tiny(), |j| j["answer_mode"]["kind"] = "generate".into(), "answer_mode.kind"),
        (Settings::depthlm(), |j| j["unit"] = "frame_max".into(), "unit"),
        (Settings::depthlm(), |j| j["unit"] = "millimetres".into(), "unit"),
    ];
    for (settings, change, wanted) in cases {
        match with(change, settings) {
            Err(Error::Config { file, key, .. }) => {
                assert_eq!((file.as_str(), key.as_str()), ("dir/sdim.json", wanted))
            }
            other => panic!("{wanted}: {other:?}"),
        }
    }
    for change in [
        (|j| j["pixel_reference"]["colour"] = serde_json::json!([256, 0, 0])) as Change,
        |j| j["pixel_reference"]["shape"] = "star".into(),
        |j| j["answer_mode"]["kind"] = "guess".into(),
        |j| j["answer_mode"]["max_new_tokens"] = (-1).into(),
        |j| j["template"] = 5.into(),
    ] {
        let error = with(change, Settings::depthlm()).unwrap_err();
        assert!(matches!(error, Error::Format { .. }), "{error}");
    }
}

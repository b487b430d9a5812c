//! Answers drawn at random.

use super::Checkpoint;
use serde_json::Value;

#[test]
fn sampled_answers_hang_on_the_seed_and_greedy_is_the_default() {
    let checkpoint = Checkpoint::new();
    let ids = |more: &[&str]| -> Vec<u64> {
        let out = checkpoint.ask(&[&["--json", "--max-new-tokens", "12"], more].concat());
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let json: Value = serde_json::from_slice(&out.stdout).unwrap();
        json["generated_ids"].as_array().unwrap().iter().map(|id| id.as_u64().unwrap()).collect()
    };
    let greedy = ids(&[]);
    let hot = ["--temperature", "3", "--seed", "1"];
    assert_eq!(ids(&hot), ids(&hot));
    assert_ne!(ids(&hot), greedy);
    assert_ne!(ids(&hot), ids(&["--temperature", "3", "--seed", "2"]));
    // All that is left of the likeliest tokens is the likeliest one.
    assert_eq!(ids(&["--temperature", "3", "--top-p", "0.000001"]), greedy);
    checkpoint.refused(&["--temperature", "0"], "temperature");
    checkpoint.refused(&["--temperature", "1", "--top-p", "1.5"], "top_p");
}

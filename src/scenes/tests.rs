use super::*;

#[test]
fn same_seed_same_frame() {
    for seed in 0..8 {
        let (a, b) = (procedural(seed, 64, 48).unwrap(), procedural(seed, 64, 48).unwrap());
        assert_eq!(a.rgb, b.rgb);
        assert!(a.depth.iter().zip(&b.depth).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert_ne!(a.rgb, procedural(seed + 100, 64, 48).unwrap().rgb);
    }
}

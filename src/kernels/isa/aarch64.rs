//! The instruction sets of 64-bit Arm.

use super::token::{Portable, instruction_sets};

instruction_sets! {
    $ is_aarch64_feature_detected
    /// The vector instructions that (nearly) every CPU of this architecture has.
    Neon = Portable + "neon";
    /// Products of pairs of bf16: FEAT_BF16.
    NeonBf16 = Neon + "bf16";
    /// Products of four bytes: FEAT_DotProd.
    NeonDotProd = Neon + "dotprod";
}

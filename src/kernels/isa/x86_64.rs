//! The instruction sets of x86-64.

use super::token::{Portable, instruction_sets};

instruction_sets! {
    $ is_x86_feature_detected
    /// AVX2 with fused multiply-add.
    Avx2 = Portable + "avx2" + "fma";
    /// The extensions that every AVX-512 CPU for servers has had since the first.
    Avx512 = Avx2 + "avx512f" + "avx512vl" + "avx512dq" + "avx512bw";
    /// Products of pairs of bf16.
    Avx512Bf16 = Avx512 + "avx512bf16";
    /// Products of four bytes.
    Avx512Vnni = Avx512 + "avx512vnni";
    /// Products of four bytes in registers of AVX2.
    AvxVnni = Avx2 + "avxvnni";
    [Amx: compiled as Avx512]
}

//! Tokens: values that prove that the CPU has an instruction set.

/// An instruction set, as a value that exists only where the CPU has it.
pub(in crate::kernels) trait Isa: Copy + Send + Sync + 'static {
    /// Whether `a * b + c` is one instruction; elsewhere [`f32::mul_add`] is a slow library call.
    const FUSED_MADD: bool;
}

/// What every CPU of the architecture has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::kernels) struct Portable;

impl Isa for Portable {
    const FUSED_MADD: bool = cfg!(target_arch = "aarch64");
}

#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
impl Portable {
    pub(super) fn detect() -> Option<Self> {
        Some(Portable)
    }
}

/// Defines the tokens of an architecture from a table `Token = Base + "feature" ...;`: a token's CPU has the features of its base and
/// those named here. Also defines `compiled_for!`, which gives a function these features:
///
/// ```text
/// compiled_for! { Avx2, fn work(isa: Avx2, x: &[f32]) -> f32 { ... } }
/// ```
///
/// At the end, `[Token: compiled as Base]` is for a token made elsewhere, whose functions have the features of another.
///
/// The first two arguments are a `$`, for the macro that this one defines, and the name of the standard library's check.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! instruction_sets {
    (
        $dollar:tt $detected:ident
        $($(#[$meta:meta])* $token:ident = $base:ident $(+ $feature:tt)+;)+
        $([$other:ident: compiled as $same:ident])*
    ) => {
        $(
            $(#[$meta])*
            #[derive(Clone, Copy, Debug, PartialEq, Eq)]
            pub(in crate::kernels) struct $token($base);

            impl $token {
                /// The token, if the CPU has the features.
                pub(in crate::kernels) fn detect() -> Option<Self> {
                    let base = $base::detect()?;
                    let detected = $(std::arch::$detected!($feature))&&+;
                    detected.then_some($token(base))
                }
            }

            impl From<$token> for $base {
                fn from(token: $token) -> Self {
                    token.0
                }
            }

            impl $crate::kernels::isa::Isa for $token {
                const FUSED_MADD: bool = true;
            }
        )+

        macro_rules! compiled_for {
            (Portable, $dollar($dollar function:tt)*) => { $dollar($dollar function)* };
            $(
                ($token, $dollar($dollar function:tt)*) => {
                    $crate::kernels::isa::compiled_for! {
                        $base, #[target_feature($(enable = $feature),+)] $dollar($dollar function)*
                    }
                };
            )+
            $(
                ($other, $dollar($dollar function:tt)*) => {
                    $crate::kernels::isa::compiled_for! { $same, $dollar($dollar function)* }
                };
            )*
        }
        pub(in crate::kernels) use compiled_for;
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(super) use instruction_sets;

/// Where there is nothing but portable code.
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
macro_rules! compiled_for {
    (Portable, $($function:tt)*) => { $($function)* };
}
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
pub(in crate::kernels) use compiled_for;

/// `$body(isa, arguments...)` compiled for the instruction set `$token`, of which `$isa` is the token; the arguments are variables
/// of these names. The body must be `#[inline(always)]`, and hold no closure that another thread runs: neither would be compiled
/// for the instruction set else.
macro_rules! call_compiled {
    ($token:ident, $isa:expr, $body:path, ($($arg:ident: $ty:ty),* $(,)?) $(-> $out:ty)?) => {{
        $crate::kernels::isa::compiled_for! {
            $token,
            #[allow(clippy::too_many_arguments)]
            fn compiled(isa: $crate::kernels::isa::$token, $($arg: $ty),*) $(-> $out)? {
                $body(isa, $($arg),*)
            }
        }
        let isa: $crate::kernels::isa::$token = $isa;
        // SAFETY: the token exists only where the CPU has the features that `compiled` is compiled for.
        #[allow(unused_unsafe)]
        unsafe {
            compiled(isa, $($arg),*)
        }
    }};
}
pub(in crate::kernels) use call_compiled;

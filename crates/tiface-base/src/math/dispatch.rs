//! One body, compiled for each level of CPU instructions, of which the best is chosen at run time.

/// Declares `fn name(args)` that runs `body::<HAS_FMA>(args)` compiled for the best level this CPU
/// has.
///
/// `fn name / body / wide (args)` has a level more: `wide::<true>(args)` on CPUs with vectors of
/// 512 bits, which must compute the same bytes. Other code gains nothing from them, and takes its
/// time to compile.
#[macro_export]
macro_rules! dispatch {
    ($(#[$meta:meta])* $vis:vis fn $name:ident / $body:ident ( $($a:ident : $t:ty),* $(,)? )) => {
        $(#[$meta])*
        $vis fn $name($($a: $t),*) {
            $crate::dispatch!(@run $body ($($a: $t),*));
        }
    };
    ($(#[$meta:meta])* $vis:vis fn $name:ident / $body:ident / $wide:ident ( $($a:ident : $t:ty),* $(,)? )) => {
        $(#[$meta])*
        $vis fn $name($($a: $t),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx2,fma,bmi2")]
                fn v4($($a: $t),*) { $wide::<true>($($a),*) }
                if std::is_x86_feature_detected!("avx512f")
                    && std::is_x86_feature_detected!("avx512vl")
                    && std::is_x86_feature_detected!("avx2")
                    && std::is_x86_feature_detected!("fma")
                    && std::is_x86_feature_detected!("bmi2")
                {
                    // SAFETY: the features were found on this CPU at run time.
                    return unsafe { v4($($a),*) };
                }
            }
            $crate::dispatch!(@run $body ($($a: $t),*));
        }
    };
    (@run $body:ident ($($a:ident : $t:ty),*)) => {
        #[cfg(target_arch = "x86_64")]
        {
            #[target_feature(enable = "avx2,fma,bmi2")]
            fn v3($($a: $t),*) { $body::<true>($($a),*) }
            if std::is_x86_feature_detected!("avx2")
                && std::is_x86_feature_detected!("fma")
                && std::is_x86_feature_detected!("bmi2")
            {
                // SAFETY: the features were found on this CPU at run time.
                return unsafe { v3($($a),*) };
            }
        }
        $body::<{ cfg!(target_arch = "aarch64") }>($($a),*)
    };
}

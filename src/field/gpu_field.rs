//! A field on a GPU, with the CPU's field in reserve.

use std::sync::{Mutex, OnceLock};
use tiface_base::Result;

/// Advice for a GPU that failed.
const GPU_HINT: &str = "`tiface doctor` tests the GPU, `--device cpu` leaves it out";

/// A field on a GPU, which is evaluated in place of the CPU's until the GPU fails.
pub struct GpuField<T> {
    field: Mutex<Option<T>>,
    failure: OnceLock<String>,
}

impl<T> GpuField<T> {
    /// Wraps a field; with `None`, [`ask`](GpuField::ask) always returns `None`.
    pub fn new(field: Option<T>) -> GpuField<T> {
        GpuField { field: Mutex::new(field), failure: OnceLock::new() }
    }

    /// Returns why the GPU is no longer used, once it has failed.
    pub fn failure(&self) -> Option<&str> {
        self.failure.get().map(String::as_str)
    }

    /// Evaluates the field on the GPU. Returns `None` without a field or if the GPU failed, so that
    /// the caller evaluates it on the CPU.
    pub fn ask<A>(&self, evaluate: impl FnOnce(&mut T) -> Result<A>) -> Option<A> {
        let mut field = self.field.lock().ok()?;
        let result = evaluate(field.as_mut()?);
        if let Err(e) = &result {
            let text = self.failure.get_or_init(|| format!("{e}; the CPU goes on. {GPU_HINT}"));
            tracing::warn!("{text}");
            *field = None;
        }
        result.ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::Error;

    #[test]
    fn a_gpu_that_failed_is_asked_no_more_and_says_why() {
        let field = GpuField::new(Some(1));
        assert_eq!((field.ask(|f| Ok(*f)), field.failure()), (Some(1), None));
        assert_eq!(field.ask(|_| Err::<i32, _>(Error::cannot("it is lost", ""))), None);
        assert_eq!(field.ask(|_| -> Result<i32> { panic!("asked again") }), None);
        let said = field.failure().unwrap();
        assert!(said.starts_with("it is lost; the CPU goes on. `tiface doctor`"), "{said}");
    }
}

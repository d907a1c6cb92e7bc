//! Every reader of foreign bytes against inputs made of its seeds: none panics, works for more than
//! a second or allocates beyond its limits.
//!
//! An input that is answered in words that no other was answered in, numbers and quotations left
//! out, becomes a seed of further ones: what the readers say stands in for what of their code was
//! reached. `TIFACE_FUZZ_S=3600` gives each reader an hour, `TIFACE_FUZZ_SEED` another beginning,
//! `TIFACE_FUZZ_READER=mesh` one reader all the time. A finding is kept beside the seeds, where it
//! is tried first from then on.

mod readers;

use readers::{READERS, Reader, prepare};
use std::alloc::{GlobalAlloc, Layout, System};
use std::collections::HashSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// What a reader may hold beyond what was held before it, bytes: its limits and as much again to
/// work with, many times.
const MAX_BYTES: usize = 160 << 20;
/// Work for one input, seconds.
const MOST_SECONDS: f64 = 1.0;
/// A reader that has not come back by then never will, on however busy a machine, seconds.
const NEVER: f64 = 60.0;
/// Longer inputs find nothing that shorter ones do not.
const LONGEST: usize = 1 << 17;

static HELD: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

struct Counted;

// SAFETY: every call is the system's own.
unsafe impl GlobalAlloc for Counted {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        PEAK.fetch_max(HELD.fetch_add(layout.size(), Relaxed) + layout.size(), Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        PEAK.fetch_max(HELD.fetch_add(layout.size(), Relaxed) + layout.size(), Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(place, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counted = Counted;

/// What a reader works on, since when, and where it is kept if nothing ever comes of it.
static NOW: Mutex<Option<(Instant, PathBuf, Vec<u8>)>> = Mutex::new(None);

/// Ends the process if a reader does not come back: nothing else ends an endless loop.
fn watch() {
    std::thread::spawn(|| {
        loop {
            std::thread::sleep(Duration::from_secs(1));
            let now = NOW.lock().unwrap();
            if let Some((_, folder, input)) = now.as_ref().filter(|now| now.0.elapsed().as_secs_f64() > NEVER)
            {
                let file = folder.join("found-hang");
                std::fs::write(&file, input).unwrap();
                eprintln!("a reader does not come back: {}", file.display());
                std::process::abort();
            }
        }
    });
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// 0 to `n` - 1; 0 for 0.
    fn below(&mut self, n: usize) -> usize {
        (self.next() % n.max(1) as u64) as usize
    }

    fn pick<'a, T: ?Sized>(&mut self, list: &[&'a T]) -> &'a T {
        list[self.below(list.len())]
    }

    /// A short range inside this many bytes.
    fn range(&mut self, len: usize) -> std::ops::Range<usize> {
        let start = self.below(len + 1);
        let most = [1, 4, 16, 64, 1024][self.below(5)];
        start..(start + self.below(most + 1)).min(len)
    }
}

/// Numbers that end ranges.
const NUMBERS: [&str; 16] = [
    "0",
    "-1",
    "1",
    "-0.0",
    "1e308",
    "-1e400",
    "1e-320",
    "NaN",
    "inf",
    "255",
    "65536",
    "2147483648",
    "4294967295",
    "9223372036854775807",
    "18446744073709551616",
    "",
];

/// One change to an input; `other` lends pieces.
fn change(input: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    let at = random.below(input.len());
    match random.below(9) {
        0 if !input.is_empty() => input[at] ^= 1 << random.below(8),
        1 if !input.is_empty() => input[at] = random.next() as u8,
        2 => drop(input.drain(random.range(input.len()))),
        3 => {
            let piece = input[random.range(input.len())].to_vec();
            for _ in 0..=random.below(3) {
                input.splice(at..at, piece.iter().copied());
            }
        }
        4 => {
            let piece = &other[random.range(other.len())];
            let cut = random.range(input.len());
            input.splice(cut, piece.iter().copied());
        }
        5 => {
            // a number of some width at the end of its range
            let value: u64 =
                [0, 1, 0x7F, 0x80, 0xFF, 0x7FFF_FFFF, 0x8000_0000, u64::MAX, u64::MAX / 2][random.below(9)];
            let width = [1, 2, 4, 8][random.below(4)];
            let mut bytes = value.to_le_bytes()[..width].to_vec();
            if random.below(2) == 0 {
                bytes.reverse();
            }
            input.splice(at..(at + width).min(input.len()), bytes);
        }
        6 => {
            // a number in words
            let digit = |b: &u8| b.is_ascii_digit() || b"+-.eE".contains(b);
            if let Some(start) = input[at..].iter().position(u8::is_ascii_digit).map(|k| at + k) {
                let length = input[start..].iter().take_while(|b| digit(b)).count();
                input.splice(start..start + length, random.pick(&NUMBERS).bytes());
            }
        }
        7 => {
            let word = random.pick(&[
                "\"", "{", "[", "]}", ",", "\n", " ", "/", "../", "\0", "-", "null", "\u{feff}", "é",
            ]);
            input.splice(at..at, word.bytes());
        }
        _ => input.truncate(at),
    }
}

/// Feeds a reader; its answer without numbers and quotations, or what is wrong.
fn feed(read: Reader, seeds: &Path, dir: &Path, input: &[u8]) -> Result<String, String> {
    *NOW.lock().unwrap() = Some((Instant::now(), seeds.into(), input.into()));
    let answer = measured(read, dir, input);
    *NOW.lock().unwrap() = None;
    answer
}

fn measured(read: Reader, dir: &Path, input: &[u8]) -> Result<String, String> {
    let before = HELD.load(Relaxed);
    PEAK.store(before, Relaxed);
    let (work, begin) = (tiface::io::cpu_seconds(), Instant::now());
    let answer = catch_unwind(AssertUnwindSafe(|| read(dir, input))).map_err(|_| "a panic".to_string())?;
    let seconds = (tiface::io::cpu_seconds() - work).min(begin.elapsed().as_secs_f64());
    let bytes = PEAK.load(Relaxed).saturating_sub(before);
    if seconds > MOST_SECONDS || bytes > MAX_BYTES {
        return Err(format!("{seconds:.2} s of work, {bytes} bytes"));
    }
    // what is quoted from the input is no answer of the reader's
    let own: String = answer.split('`').step_by(2).collect();
    Ok(own.chars().filter(|c| !c.is_ascii_digit()).take(160).collect())
}

fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |value| value.parse().unwrap())
}

#[test]
fn no_input_makes_a_reader_panic_hang_or_fill_the_memory() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/seeds");
    let folders = std::fs::read_dir(&root).unwrap().count();
    assert_eq!(folders, READERS.len(), "seeds of a reader that is not there");
    let seconds = Duration::from_secs(setting("TIFACE_FUZZ_S", 3));
    let only = std::env::var("TIFACE_FUZZ_READER").ok();
    // memory is counted by process: every second reader is fed in another one, at the same time
    let half = std::env::var("TIFACE_FUZZ_HALF").map(|half| half.parse::<usize>().unwrap()).ok();
    let other = (half.is_none() && only.is_none()).then(|| {
        let mut other = Command::new(std::env::current_exe().unwrap());
        other.args(["--exact", "no_input_makes_a_reader_panic_hang_or_fill_the_memory", "--nocapture"]);
        other.env("TIFACE_FUZZ_HALF", "1").stdout(Stdio::piped()).spawn().unwrap()
    });
    let mine = |i: usize| only.is_some() || i % 2 == half.unwrap_or(0);
    let readers = READERS.into_iter().enumerate().filter(|(i, _)| mine(*i)).map(|(_, reader)| reader);
    // files are written a million times: into memory, where there is such a place
    let scratch = Path::new("/dev/shm");
    let scratch = if scratch.is_dir() { scratch.to_path_buf() } else { std::env::temp_dir() };
    watch();
    let (mut total, mut findings) = (0u64, Vec::new());
    for (name, read) in readers.filter(|(name, _)| only.as_ref().is_none_or(|o| o == name)) {
        let dir = tempfile::tempdir_in(&scratch).unwrap();
        prepare(dir.path());
        let mut found = |what: String, input: &[u8]| {
            let digest = tiface::Fingerprint::of_bytes(input);
            let file = root.join(name).join(format!("found-{}", &digest[..12]));
            std::fs::write(&file, input).unwrap();
            findings.push(format!("{name}: {what}: {}", file.display()));
        };
        let seeds = root.join(name);
        let mut answers = HashSet::new();
        let mut pool: Vec<Vec<u8>> = Vec::new();
        for entry in std::fs::read_dir(root.join(name)).unwrap() {
            let input = std::fs::read(entry.unwrap().path()).unwrap();
            match feed(read, &seeds, dir.path(), &input) {
                Ok(answer) => drop(answers.insert(answer)),
                Err(what) => found(what, &input),
            }
            pool.push(input);
        }
        // what is never read whole is only known at its door
        assert!(answers.contains(""), "no seed of `{name}` is read: {answers:?}");
        let mut random = Random(setting("TIFACE_FUZZ_SEED", 1));
        let (begin, mut count, mut wrong) = (Instant::now(), 0u64, 0);
        while begin.elapsed() < seconds && wrong < 3 {
            // what was found last is the least known
            let newest = pool.len() - 1 - random.below(pool.len().min(8));
            let place = if random.below(3) == 0 { newest } else { random.below(pool.len()) };
            let mut input = pool[place].clone();
            for _ in 0..=random.below(4) {
                let other = random.below(pool.len());
                change(&mut input, &pool[other], &mut random);
            }
            input.truncate(LONGEST);
            count += 1;
            match feed(read, &seeds, dir.path(), &input) {
                Ok(answer) => {
                    if answers.insert(answer) {
                        pool.push(input);
                    }
                }
                Err(what) => {
                    found(what, &input);
                    wrong += 1;
                }
            }
        }
        eprintln!("{name:<15} {count:>9} inputs, {:>4} different answers", answers.len());
        total += count;
    }
    eprintln!("{total} inputs, {} findings", findings.len());
    if let Some(other) = other {
        let output = other.wait_with_output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        // it says itself what it found
        if !output.status.success() || !text.contains("1 passed") {
            findings.push(format!("the other half: {}: {text}", output.status));
        }
    }
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

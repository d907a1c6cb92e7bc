//! Readbacks, refusals of drivers and memory.

use super::super::testing::{alone, device};
use super::*;
use burn::cubecl::wgpu::{AutoGraphicsApi, RuntimeOptions, try_init_setup};
use burn::cubecl::{self, prelude::*};

#[test]
fn what_is_copied_there_comes_back() {
    let Some(device) = device() else { return };
    let uploaded = device.upload(&[1.5f32, -2.0, 3.0]);
    assert_eq!(device.read::<f32>(&uploaded), [1.5, -2.0, 3.0]);
    assert_eq!(device.read::<u32>(&device.zeros::<u32>(5)), [0; 5]);
    assert_eq!(device.counts(), (0, 2));
    println!("{} adds floats: {:?}", device.name(), device.atomics());
}

#[test]
fn what_a_driver_refuses_is_an_error_and_nothing_read_after_it_is_trusted() {
    if device().is_some() {
        for test in [
            "a_launch_of_too_many_groups",
            "a_buffer_larger_than_memory",
            "a_kernel_that_does_not_compile",
            "a_group_of_too_many_threads",
            "a_device_that_is_lost",
        ] {
            alone(&format!("gpu::device::tests::{test}"));
        }
    }
}

#[cube(launch)]
fn set(out: &mut [f32]) {
    if ABSOLUTE_POS < out.len() {
        out[ABSOLUTE_POS] = 1.0f32;
    }
}

#[test]
#[ignore = "run by the test above, in a process of its own"]
fn a_launch_of_too_many_groups() {
    let device = device().unwrap();
    let out = device.zeros::<f32>(64);
    let set = |groups: u32| launch!(device, set::launch, CubeCount::new_1d(groups), 64; out);
    (0..8).for_each(|_| set(1));
    set(70_000);
    (0..8).for_each(|_| set(1));
    let e = device.fetch::<f32>(&out).expect_err("a launch was lost");
    println!("{e}: {}", e.hint());
    assert!(e.kind() as i32 == 1 && e.to_string().contains("65535"), "{e}");
    // what comes after it is done
    set(1);
    assert_eq!(device.fetch::<f32>(&out).unwrap(), [1.0; 64]);
}

#[test]
#[ignore = "run by the test above, in a process of its own"]
fn a_buffer_larger_than_memory() {
    let device = device().unwrap();
    let pages = std::fs::read_to_string("/proc/self/statm").unwrap();
    let pages: u64 = pages.split(' ').next().unwrap().parse().unwrap();
    let bytes = Some(4096 * pages + (1 << 30));
    let limit = rustix::process::Rlimit { current: bytes, maximum: bytes };
    rustix::process::setrlimit(rustix::process::Resource::As, limit).unwrap();
    let words = device.limits().largest_buffer as usize / 4;
    let all: Vec<Buffer> = (0..64).map(|_| device.scratch::<f32>(words)).collect();
    for out in &all {
        launch!(device, set::launch, CubeCount::new_1d(1), 64; out);
    }
    let e = device.fetch::<f32>(&all[63]).expect_err("64 of the largest buffers do not fit in a GiB");
    println!("{e}: {}", e.hint());
    assert!(e.kind() as i32 == 75 && e.hint().contains("--memory"), "{e}");
}

#[cube(launch)]
fn crowded(out: &mut [f32], #[comptime] words: usize) {
    let mut all = Shared::<[f32]>::new_slice(words);
    all[UNIT_POS as usize] = 1.0f32;
    sync_cube();
    out[ABSOLUTE_POS] = all[words - 1 - UNIT_POS as usize];
}

/// A kernel that is refused is an error that names it, and no reason to repeat the command.
fn is_refused(device: &Device, out: &Buffer, kernel: &str) {
    let e = device.fetch::<f32>(out).expect_err("the kernel cannot run");
    println!("{e}: {}", e.hint());
    assert!(e.kind() as i32 == 1 && e.to_string().to_lowercase().contains(kernel), "{e}");
}

#[test]
#[ignore = "run by the test above, in a process of its own"]
fn a_kernel_that_does_not_compile() {
    let device = device().unwrap();
    let out = device.zeros::<f32>(64);
    let words = device.limits().shared;
    launch!(device, crowded::launch, CubeCount::new_single(), 64; out; words);
    is_refused(&device, &out, "crowded");
}

#[test]
#[ignore = "run by the test above, in a process of its own"]
fn a_group_of_too_many_threads() {
    let device = device().unwrap();
    let out = device.zeros::<f32>(64);
    launch!(device, set::launch, CubeCount::new_single(), 1 << 20; out);
    is_refused(&device, &out, "set");
}

#[test]
#[ignore = "run by the test above, in a process of its own"]
fn a_device_that_is_lost() {
    let adapter = &Adapter::all()[0];
    let CubeDevice::Wgpu(wgpu_device) = &adapter.device else { panic!("not a device of wgpu") };
    let options = RuntimeOptions::try_default().unwrap();
    let setup = try_init_setup::<AutoGraphicsApi>(wgpu_device, options).unwrap();
    let device = Device::open(adapter).unwrap();
    let out = device.zeros::<f32>(64);
    let set = || launch!(device, set::launch, CubeCount::new_single(), 64; out);
    set();
    assert_eq!(device.fetch::<f32>(&out).unwrap(), [1.0; 64]);
    setup.device.destroy();
    // nothing is trusted from then on
    for _ in 0..3 {
        set();
        let e = device.fetch::<f32>(&out).expect_err("the device is lost");
        println!("{e}: {}", e.hint());
        assert!(e.kind() as i32 == 75 && e.hint().contains("repeat"), "{e}");
    }
}

#[test]
fn buffers_take_what_they_are_asked_for() {
    if device().is_some() {
        alone("gpu::device::tests::memory_of_buffers");
    }
}

#[test]
#[ignore = "run by the test above, in a process of its own"]
fn memory_of_buffers() {
    let device = device().unwrap();
    const MIB: usize = 1 << 18;
    let before = device.reserved_memory();
    let sizes = std::iter::once(30).chain([7; 20]).chain([1; 8]);
    let all: Vec<Buffer> = sizes.map(|mib| device.zeros::<f32>(mib * MIB)).collect();
    device.read::<f32>(&all[all.len() - 1]);
    let requested: usize = all.iter().map(|buffer| 4 * buffer.word_count()).sum();
    let taken = device.reserved_memory() - before;
    println!("{requested} bytes of buffers take {taken}");
    assert!(taken as f64 <= 1.05 * requested as f64, "{taken} of {requested}");
}

#[test]
fn an_adapter_that_cannot_be_opened_is_an_error_each_time() {
    let absent = Adapter::absent("a card that fell out");
    for _ in 0..2 {
        let e = Device::open(&absent).err().unwrap();
        println!("{e}: {}", e.hint());
        assert!(
            e.kind() as i32 == 1 && e.to_string().contains("`a card that fell out` cannot be opened"),
            "{e}"
        );
    }
}

#[test]
fn a_user_gives_a_device_more_memory_than_its_driver_states() {
    let Some(device) = device() else { return };
    let device = device.with_memory(1 << 20);
    assert_eq!(device.available_memory(), 0);
    assert_eq!(device.with_memory(1 << 50).available_memory(), (1 << 50) - (512 << 20));
}

#[test]
fn many_groups_lie_in_two_dimensions() {
    let size = |n: usize| match groups(n) {
        CubeCount::Static(x, y, z) => [x, y, z],
        _ => [0; 3],
    };
    assert_eq!([size(1), size(65_535), size(65_536)], [[1, 1, 1], [65_535, 1, 1], [32_768, 2, 1]]);
}

"""Heads that take seconds: settings, and photographs of the demo head; for the checks in `fleet` and `guides`."""

import subprocess
import time

# With a checkpoint often enough that kills leave something to go on from. What a command's own options say
# wins.
SETTINGS = """
device = "cpu"
[iface]
steps = 120
rays = 256
max_rays = 512
samples = 4096
levels = 6
log2_table = 12
occupancy_resolution = 32
checkpoint_s = 0.1
[tface]
steps = 60
fields = 1
rays = 512
voxels_start = 4096
voxels_final = 13824
checkpoint_s = 0.1
[baseline]
steps = 20
rays = 256
[mesh]
resolution = 48
texture_px = 256
[render]
samples = 1
"""


def photograph(tiface, run, size, environment=None):
    """Returns a folder of ten photographs with cameras and masks; cameras are written last, and nothing is learned."""
    words = [tiface, "demo", "--run", run, "--size", size, "--views", "10", "--quiet"]
    demo = subprocess.Popen([str(word) for word in words], env=environment)
    while not (run / "capture/transforms.json").is_file():
        assert demo.poll() is None, "the demo head was not photographed"
        time.sleep(0.02)
    demo.kill()
    demo.wait()
    return run / "capture"

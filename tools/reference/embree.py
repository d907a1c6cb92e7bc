"""Embree (through open3d) on the mesh and rays that `benches/raycast.rs -- --dump DIR` wrote.

    cargo bench --bench raycast -- --dump DIR
    python tools/reference/embree.py DIR

Prints Mrays/s on one thread and how many rays hit, to compare with the bench's own lines.
Needs tools/readers/requirements.txt.
"""

import pathlib
import sys
import time

import numpy
import open3d

folder = pathlib.Path(sys.argv[1])
mesh = open3d.io.read_triangle_mesh(str(folder / "mesh.ply"))
start = time.perf_counter()
scene = open3d.t.geometry.RaycastingScene(nthreads=1)
scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
scene.cast_rays(numpy.array([[0, 0, 9, 0, 0, 1]], numpy.float32))  # the tree is built on first use
print(f"{len(mesh.triangles)} triangles, built in {time.perf_counter() - start:.3f} s")
for name in ["primary", "random"]:
    rays = numpy.fromfile(folder / f"{name}.f32", numpy.float32).reshape(-1, 6)
    seconds = float("inf")
    for _ in range(5):
        start = time.perf_counter()
        answer = scene.cast_rays(rays, nthreads=1)
        seconds = min(seconds, time.perf_counter() - start)
    hits = int(numpy.isfinite(answer["t_hit"].numpy()).sum())
    print(f"{name:8} {len(rays) * 1e-6 / seconds:6.2f} Mrays/s   {hits} of {len(rays)} hit")

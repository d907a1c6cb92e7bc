"""Times VTK's flying edges on a raw f32 volume and, interleaved, another command on the same file.

    pip install vtk numpy
    cargo bench --bench marching -- --write head 256 volume.f32
    python tools/reference/flying_edges.py 256 volume.f32 [rounds] [command ...]

The command is run once a round between VTK's runs; its last line must hold `NUMBER ms`, as
`cargo bench --bench marching -- --read 256 volume.f32` prints. The ratio compares medians of rounds.
"""

import re
import statistics
import subprocess
import sys
import time

import numpy
import vtk
from vtk.util.numpy_support import numpy_to_vtk


def load(n, path):
    values = numpy.fromfile(path, dtype="<f4")
    if values.size != n**3:
        sys.exit(f"{path}: expected {n**3} values, found {values.size}")
    image = vtk.vtkImageData()
    image.SetDimensions(n, n, n)
    image.SetSpacing(*[2 / (n - 1)] * 3)
    image.GetPointData().SetScalars(numpy_to_vtk(values, deep=True))
    return image


def flying_edges(image):
    """Best of seven, in ms; points and triangles only, as ours."""
    best = float("inf")
    for _ in range(7):
        edges = vtk.vtkFlyingEdges3D()
        edges.SetInputData(image)
        edges.SetValue(0, 0.0)
        edges.ComputeNormalsOff()
        edges.ComputeGradientsOff()
        edges.ComputeScalarsOff()
        start = time.perf_counter()
        edges.Update()
        best = min(best, 1e3 * (time.perf_counter() - start))
    return best, edges.GetOutput().GetNumberOfCells()


def main():
    n, path = int(sys.argv[1]), sys.argv[2]
    rounds = int(sys.argv[3]) if len(sys.argv) > 3 else 3
    command = sys.argv[4:]
    vtk.vtkSMPTools.Initialize(1)  # one thread
    image = load(n, path)
    theirs, ours = [], []
    for _ in range(rounds):
        ms, triangles = flying_edges(image)
        theirs.append(ms)
        if command:
            text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            ours.append(float(re.findall(r"([0-9.]+) ms", text)[-1]))
    print(f"vtk {statistics.median(theirs):.2f} ms, {triangles} triangles")
    if ours:
        ratio = statistics.median(ours) / statistics.median(theirs)
        print(f"command {statistics.median(ours):.2f} ms, {ratio:.2f} of vtk")


if __name__ == "__main__":
    main()

"""Axes that every reader's check turns by."""

import numpy


def turn_to_y_up(up):
    """The smallest rotation that brings `up` to +Y."""
    up = numpy.asarray(up, float) / numpy.linalg.norm(up)
    if up[1] < -1 + 1e-12:
        return numpy.diag([1.0, -1.0, -1.0])
    x, y, z = numpy.cross(up, [0, 1, 0])
    skew = numpy.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return numpy.eye(3) + skew + skew @ skew / (1 + up[1])

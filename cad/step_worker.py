"""Turns a STEP file on standard input into GLB on standard output; ``cad.step`` runs it as a process of its own.

Arguments: largest distance in mm and largest angle in radians between a surface and its triangles. What the CAD
kernel prints goes to standard error.
"""

import os
import sys

import cascadio


def main() -> None:
    """Convert; exit with status 1 where the kernel gives nothing."""
    output = os.dup(1)
    os.dup2(2, 1)  # the kernel writes its messages to standard output
    deflection_mm, angle_rad = map(float, sys.argv[1:])
    data = cascadio.load(sys.stdin.buffer.read(), tol_linear=deflection_mm, tol_angular=angle_rad, use_parallel=False)
    with os.fdopen(output, "wb") as stream:
        stream.write(data)
    sys.exit(0 if data else 1)


if __name__ == "__main__":
    main()

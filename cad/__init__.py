"""Geometry and facts of the cell: frames, parts, robot dimensions, tagboard. Imports no other Tagcell package."""

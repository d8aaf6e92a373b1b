"""The MuJoCo world of the cell: physics, cameras, rendering and labelled data sets."""

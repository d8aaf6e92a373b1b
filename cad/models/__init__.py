"""Scripts that make the solids and fill the part folders (extra ``cad``). Running the cell does not need them."""

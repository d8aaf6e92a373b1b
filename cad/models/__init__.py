"""Scripts that make the parts' solids (extra ``cad``) and fill the part folders. Running the cell does not need them."""

"""Cross-sections of members: their shapes, the fit of one, and the choice between them."""

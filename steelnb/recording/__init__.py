"""A recording → corrected poses and bars; a cloud → its bars."""

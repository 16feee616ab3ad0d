"""A scan planned from the part: stations, choice, order, and what is to be expected."""

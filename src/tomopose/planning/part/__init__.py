"""A scan planned from the part: which views show its features best, within the machine's limits."""

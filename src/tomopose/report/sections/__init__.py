"""Parts that several pages of a report share."""

"""Volume and poses of one level, fitted together."""

"""What is planned for: the part, its features, and what views of them are worth."""

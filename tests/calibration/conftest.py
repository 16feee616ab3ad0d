"""The scanner of these tests is exact unless a test says otherwise: its values are stated with sigma 0."""

from __future__ import annotations

import pytest

from tomopose import Scanner


@pytest.fixture
def scanner(scanner: Scanner) -> Scanner:
    return scanner.exact()

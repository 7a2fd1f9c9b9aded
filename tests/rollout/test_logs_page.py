"""The page about logs lists what the code has."""

from pathlib import Path

from op3.rollout.health import checks_table
from op3.rollout.readers import formats_table
from op3.rollout.schema import schema_table

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "logs.md").read_text(encoding="utf-8")


def test_the_page_holds_the_tables_of_the_code():
    """Channels, formats and checks stand there as the code prints them."""
    for table in (schema_table(), formats_table(), checks_table()):
        assert table in PAGE

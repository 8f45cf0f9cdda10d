"""The site file's JSON Schema, for editors: `python -m sonofix.files.schema > docs/site.schema.json`."""

from __future__ import annotations

import json
import sys
from typing import Any

from sonofix.site import Site


def site_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of `site.toml`; rules between several values are not in it."""
    schema = Site.model_json_schema(by_alias=True)
    # A Site built in Python may leave these out; a file may not.
    schema["required"] = ["format", "beacon"]
    schema["properties"]["beacon"]["minItems"] = 1
    for definition in schema["$defs"].values():
        if "const" in definition["properties"].get("family", {}):
            definition["required"] = ["family", *definition["required"]]
    schema = _for_toml(schema)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "sonofix site file, format 1",
    }


def _for_toml(part: Any) -> Any:
    """Drop what TOML has not (null) and titles that only repeat the key."""
    if isinstance(part, list):
        return [_for_toml(item) for item in part]
    if not isinstance(part, dict):
        return part
    kept = {key: value for key, value in part.items() if value is not None}
    if isinstance(kept.get("title"), str):
        del kept["title"]
    if "anyOf" in kept:
        choices = [choice for choice in kept.pop("anyOf") if choice != {"type": "null"}]
        kept |= choices[0] if len(choices) == 1 else {"anyOf": choices}
    return {key: _for_toml(value) for key, value in kept.items()}


def schema_text() -> str:
    """Return the schema as the published file holds it."""
    return json.dumps(site_schema(), indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    sys.stdout.write(schema_text())

"""The Khronos validator of glTF, where Node finds it: `npm install gltf-validator`, NODE_PATH=.../node_modules."""

import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

__all__ = ["khronos_findings"]

SEVERITIES = ("error", "warning")
# Tangents are left to viewers, as the format allows: all of them make the same of normals and coordinates.
ON_PURPOSE = ("MESH_PRIMITIVE_GENERATED_TANGENT_SPACE",)
PROGRAM = """
const fs = require("fs"), validator = require("gltf-validator");
const report = (file) => validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {maxIssues: 1000});
Promise.all(process.argv.slice(1).map(report)).then((all) => {
  console.log(JSON.stringify(all.map((one) => one.issues.messages)));
});
"""


def khronos_findings(files: Sequence[Path]) -> list[list[str]]:
    """Errors and warnings of each file; the test is skipped where Node or the package is absent."""
    node = shutil.which("node")
    if (
        node is None
        or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode
    ):
        pytest.skip("needs Node with the package gltf-validator (npm install gltf-validator, NODE_PATH)")
    done = subprocess.run([node, "-e", PROGRAM, *map(str, files)], capture_output=True, text=True, check=True)
    return [
        [
            f"{SEVERITIES[issue['severity']]} {issue['code']} at {issue.get('pointer', '')}: {issue['message']}"
            for issue in issues
            if issue["severity"] < len(SEVERITIES) and issue["code"] not in ON_PURPOSE
        ]
        for issues in json.loads(done.stdout)
    ]

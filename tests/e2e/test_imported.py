"""A .conf file of rtkrcv, imported, and run as a deployment of real processes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtkmesh_services.cli.main import run

CONF = """\
# rtkrcv options (2023/01/02 03:04:05, v.demo5 b34k)
inpstr1-type       =file
inpstr1-path       ={data}/tokyo_static/rover.obs::x20
inpstr1-format     =rinex
inpstr2-type       =file
inpstr2-path       ={data}/tokyo_static/base.obs::x20
inpstr2-format     =rinex
inpstr3-type       =file
inpstr3-path       ={data}/tokyo_static/base.nav
inpstr3-format     =rinex
outstr1-type       =file
outstr1-path       ={folder}/sol.pos
outstr1-format     =enu
pos1-posmode       =kinematic
pos1-frequency     =l1+l2
pos1-navsys        =45
pos2-syncsol       =on
out-timeform       =tow
ant2-postype       =xyz
ant2-pos1          =-3817680.7270
ant2-pos2          =3562839.5216
ant2-pos3          =3650159.2407
"""


@pytest.mark.e2e
@pytest.mark.data
@pytest.mark.slow
def test_an_imported_deployment_runs(up: Callable[..., Any], compiled: None, data: Path, tmp_path: Path) -> None:
    """Its solver fixes the recording, and the output writes RTKLIB's lines: week, seconds, a baseline of 0.99 m, Q 1."""
    conf, out = tmp_path / "rtkrcv.conf", tmp_path / "imported.toml"
    conf.write_text(CONF.format(data=data, folder=tmp_path))
    assert run(["conf", "import", str(conf), "--out", str(out)]) == 0
    deployment = up(out.read_text())
    fixes = deployment.fixes("rtk")
    deployment.until(lambda: len(fixes) >= 20, 120.0)
    written = tmp_path / "sol.pos"

    def fixed_lines() -> list[list[str]]:
        lines = written.read_text().splitlines() if written.exists() else []
        return [row for line in lines[:-1] if not line.startswith("%") and (row := line.split())[5] == "1"]

    rows = deployment.until(lambda: len(found := fixed_lines()) >= 10 and found)
    assert all(row[0] == "2320" for row in rows)
    lengths = [sum(float(value) ** 2 for value in row[2:5]) ** 0.5 for row in rows]
    assert sorted(lengths)[len(lengths) // 2] == pytest.approx(0.99, abs=0.02)

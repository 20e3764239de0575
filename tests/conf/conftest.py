"""A .conf file of rtkrcv that uses most of what it can: lines are replaced by name."""

from collections.abc import Callable
from pathlib import Path

import pytest

from rtkmesh_services.control.endpoints import free_port as free_loopback_port

RTKRCV = """\
# rtkrcv options (2023/01/02 03:04:05, v.demo5 b34k)
console-passwd     =open sesame
inpstr1-type       =serial     # (0:off,1:serial,2:file,3:tcpsvr,4:tcpcli,6:ntripcli,7:ftp,8:http)
inpstr2-type       =ntripcli
inpstr3-type       =tcpsvr
inpstr1-path       =ttyACM0:460800:8:n:1:off
inpstr2-path       =ann:p:w@caster.example:2102/ROOF:
inpstr3-path       =:@:8601/:
inpstr1-format     =ubx
inpstr2-format     =rtcm3
inpstr3-format     =rtcm3
inpstr1-rcvopt     =-TADJ=0.1 -GL2L
inpstr2-nmeareq    =latlon
inpstr2-nmealat    =47.5
inpstr2-nmealon    =-8.25
inpstr2-nmeahgt    =500
outstr1-type       =file
outstr2-type       =tcpsvr
outstr1-path       =sol_%Y%m%d.pos::S=1::T
outstr2-path       =:5010
outstr1-format     =llh
outstr2-format     =nmea
logstr1-type       =file
logstr2-type       =tcpcli
logstr1-path       =logs/%Y/rover_%m%d.ubx::S=1::T
logstr2-path       =logger.example:7001
misc-timeout       =20000
misc-nmeacycle     =2000
misc-fswapmargin   =10
file-cmdfile1      =m8t.cmd
pos1-posmode       =5          # moving base of demo5
pos1-frequency     =l1+l2+l5
pos1-elmask        =12.5
pos1-snrmask_r     =on
pos1-snrmask_L1    =35,35,35,35,35,35,35,35,35
pos1-snrmask_L2    =30,31,32,33,34,35,36,37,38
pos1-snrmask_L5    =33,33,33,33,33,33,33,33,33
pos1-dynamics      =on
pos1-tidecorr      =1
pos1-exclsats      =G05 R12
pos1-navsys        =45
pos2-armode        =fix-and-hold
pos2-gloarmode     =fix-and-hold
pos2-bdsarmode     =on
pos2-arfilter      =on
pos2-arthres       =2.5
pos2-arlockcnt     =3
pos2-minfixsats    =8
pos2-arelmask      =20
pos2-maxage        =5
pos2-syncsol       =on
pos2-baselen       =1.05
pos2-basesig       =0.004
out-outhead        =off
out-outvel         =on
out-timesys        =utc
out-timeform       =tow
out-timendec       =2
out-degform        =dms
out-fieldsep       =,
out-outsingle      =on
out-maxsolstd      =2
out-nmeaintv2      =1
out-outstat        =residual
stats-eratio1      =200
stats-errphase     =0.004
stats-prnaccelh    =2
ant2-postype       =rtcm
file-rcvantfile    =igs14.atx
file-solstatfile   =rtk.stat
"""


@pytest.fixture
def rtkrcv() -> Callable[..., bytes]:
    """A function that returns the file with other values of keys (``None``: without the line)."""

    def conf(**values: str | None) -> bytes:
        lines = RTKRCV.splitlines()
        for name, value in values.items():
            key = name.replace("__", "-")
            lines = [line for line in lines if not line.startswith(f"{key} ")]
            lines += [] if value is None else [f"{key} ={value}"]
        return ("\n".join(lines) + "\n").encode()

    return conf


@pytest.fixture(scope="session")
def confs(data: Path) -> list[Path]:
    """The .conf files that users of rtkrcv_ros, demo5 and 2.4.1 start from."""
    return sorted((data / "conf").glob("*/*.conf"))


@pytest.fixture(scope="session")
def free_port() -> Callable[[], int]:
    """A function that returns a loopback port that nobody listens on."""
    return free_loopback_port

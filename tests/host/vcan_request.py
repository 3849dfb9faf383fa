"""An order for the vcan lab that the tests vary."""

from host.vcan_lab.spec import Request

REQUEST = Request(argv=("true",), cwd="/", env={"A": "b"}, uid=1000, gid=100, groups=(100, 4), umask=0o22, mem_mb=256)

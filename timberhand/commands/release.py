"""``timberhand release``: make, sign and check bundles, for those who bring releases to machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode

app = typer.Typer(no_args_is_help=True, help="Make, sign and check the bundles that bring a release to a machine.")
KeyOption = Annotated[
    Path, typer.Option("--key", metavar="FILE", help="Private key that signs; it never comes to a machine.")
]
PublicOption = Annotated[
    Path | None,
    typer.Option("--public-key", metavar="FILE", help="Public key to check with (default: the installed one)."),
]


@app.command()
def keygen(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for both keys; made if missing.")],
) -> None:
    """Make a pair of Ed25519 keys: signing-key.pem, which is secret, and signer.pem for the machines.

    [bold]Examples[/bold]

      timberhand release keygen ~/timberhand-keys
    """
    from host.release.signature import make_keys

    private, public = make_keys(folder)
    print(f"{private}: secret; keep it off every machine")
    print(f"{public}: for the machines, as /etc/timberhand/signer.pem")


@app.command()
def bundle(
    wheel: Annotated[Path, typer.Argument(metavar="WHEEL", help="Wheel of timberhand, as make wheel builds it.")],
    key: KeyOption,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the bundle goes.")] = Path("dist"),
    find_links: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Take all packages from DIR, without a network.")
    ] = None,
    only_program: Annotated[
        bool, typer.Option("--only-program", help="Leave the packages out: for an installation --from-environment.")
    ] = False,
    with_plant: Annotated[
        bool, typer.Option("--with-plant", help="Bring the physics plant, too: for the demo without a machine.")
    ] = False,
) -> None:
    """Make a signed bundle: the wheel and every package that a machine needs, with their hashes.

    The wheel for arm64 brings the packages for arm64, where the plant has none.

    [bold]Examples[/bold]

      timberhand release bundle dist/timberhand-0.1.0-cp311-cp311-linux_x86_64.whl --key ~/keys/signing-key.pem
    """
    from host.release import bundle as bundles

    if only_program and with_plant:
        raise CommandFailed(
            "bundle.plant-left-out", "--only-program leaves the plant out; use one of both options", ExitCode.USAGE
        )
    packages = bundles.Lock.PLANT if with_plant else bundles.Lock.MACHINE
    print(bundles.make(wheel, key, out, find_links, None if only_program else packages))


@app.command()
def sign(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File to sign, as a machine's list of its settings.")],
    key: KeyOption,
) -> None:
    """Sign a file; the signature is FILE.sig beside it.

    [bold]Examples[/bold]

      timberhand release sign configuration.sha256 --key ~/keys/signing-key.pem
    """
    from host.release.signature import sign as write_signature

    print(write_signature(file, key))


@app.command()
def verify(
    bundle: Annotated[Path, typer.Argument(metavar="BUNDLE", help="Bundle, a tar file, or a folder with its files.")],
    public_key: PublicOption = None,
) -> None:
    """Check a bundle: its signature, and every file.  Exit code 3 when it is not what was signed.

    [bold]Examples[/bold]

      timberhand release verify timberhand-0.1.0-3f2a91c07d15.tar --public-key signer.pem
    """
    import tempfile

    from host.release import bundle as bundles
    from host.release.updater import SIGNER

    with tempfile.TemporaryDirectory(prefix="timberhand-") as folder:
        bundle_folder = bundle if bundle.is_dir() else Path(folder, "bundle")
        if bundle_folder is not bundle:
            bundles.unpack(bundle, bundle_folder)
        release = bundles.check(bundle_folder, public_key or SIGNER)
    print(f"{release.name}, for {release.machine}: signature and every file are good")

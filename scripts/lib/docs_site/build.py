"""`scripts/docs`: the documents as a site."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from code_lines import ROOT
from docs_site.navigation import FRONT
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError

HELP = """\
Build the documentation site: README, docs, READMEs of the packages, and a reference generated from
the code (nodes, topics, services, parameters, diagnostics, command lines, libraries). The site can
be read from the disk or a web server, without a network.
"""
EPILOG = """\
The first call installs Sphinx.

exit codes: 0 done; 1 a link is broken, a page is missing in docs/README.md, or another warning of
Sphinx; 2 invalid arguments or missing input; 130 interrupted
"""
OUT = "site"
_HERE = Path(__file__).parent
_BUILT = ".buildinfo"
_FRONT_PAGE = FRONT.replace(".md", ".html")
_INDEX = f"""\
<!doctype html>
<title>Needle steering</title>
<meta http-equiv="refresh" content="0; url={_FRONT_PAGE}">
<a href="{_FRONT_PAGE}">Needle steering</a>
"""


def build(out: Path) -> bool:
    """Write the site into a folder; return False if Sphinx printed warnings."""
    # Import late, because this takes seconds and the command line may be invalid.
    from sphinx.cmd.build import main as sphinx  # noqa: PLC0415

    from docs_site.api_pages import api_pages  # noqa: PLC0415
    from docs_site.source_tree import write_tree  # noqa: PLC0415
    from reference.pages import pages  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as scratch:
        source, trees = Path(scratch, "source"), Path(scratch, "trees")
        print("docs: writing the reference from the nodes and commands", file=sys.stderr)
        write_tree(source, {**pages(), **api_pages()})
        print("docs: writing the site", file=sys.stderr)
        how = ("-q", "-W", "--keep-going", "-b", "html", "-c", _HERE, "-d", trees)
        code = sphinx([str(part) for part in (*how, source, out)])
    (out / "index.html").write_text(_INDEX, encoding="utf-8")
    return bool(code == 0)


def main() -> int:
    """Run `docs`; return its exit code."""
    return run_command(_docs)


def _docs() -> int:
    parser = CommandParser("docs", HELP, EPILOG)
    parser.add_argument(
        "--out", metavar="DIR", default=str(ROOT / OUT), help=f"output folder (default: {OUT}/)"
    )
    out = Path(parser.parse_args().out).expanduser()
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out} is not a folder")
    if out.is_dir() and any(out.iterdir()):
        if not (out / _BUILT).is_file():
            raise UserError(f"--out {out}: it contains something other than a site")
        shutil.rmtree(out)
    good = build(out)
    print(f"site: {out / 'index.html'}")
    return EXIT_DONE if good else EXIT_MISSED


if __name__ == "__main__":
    sys.exit(main())

"""The commands, thin: each one reads its arguments, calls the room that does the work, and prints what came back.

Exit status: 0 when the command did what it was asked and liked what it saw, 1 when it did but did not like it (a
gradient that fails its check, a machine on which nothing runs), 2 when the user has to mend something first, 128 plus
the signal's number when a signal ended it (130 for Ctrl-C; `optimize` writes everything and ends with 0). Heavy
modules are imported inside the commands, so that `pathreplay --help` answers at once.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import typer
import typer.core

from pathreplay.errors import PathreplayError, plain_line
from pathreplay.platform import address_space, interrupts
from pathreplay.report.watch import commands

_UsageError: Any = typer.BadParameter.__base__
"""What typer raises for a command line that is none; it exports one kind only, whose base they share."""


class _Ended(BaseException):
    """A KeyboardInterrupt on its way to `main`."""


class _Commands(typer.core.TyperGroup):
    """Commands whose interruption reaches `main`: typer has its own ideas of what to print and return then."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as interrupt:
            raise _Ended from interrupt


def _end(interrupt: BaseException) -> NoReturn:
    for number in interrupts.ENDING:
        signal.signal(number, signal.SIG_IGN)  # a second one finds the process on its way out
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"pathreplay: {str(interrupt) or 'ended by Ctrl-C'}", file=sys.stderr, flush=True)
    raise SystemExit(128 + getattr(interrupt, "number", signal.SIGINT))


app = typer.Typer(
    name="pathreplay",
    cls=_Commands,
    help="Differentiable light transport on Mitsuba 3: check gradients, recover scenes from pictures.",
    rich_markup_mode=None,  # Typer's panels show a flag as if it took a value: "--quiet <bool>"
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from pathreplay import __version__

        typer.echo(f"pathreplay {__version__}")
        raise typer.Exit()


@app.callback()
def _global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Options that hold for every command."""


@app.command(short_help="Say what runs on this machine.")
def doctor(
    gpu: Annotated[bool, typer.Option("--gpu", help="Run truths and timings on the GPU, and write a file.")] = False,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="With --gpu: the file to write.")
    ] = Path("pathreplay-gpu.json"),
    variant: Annotated[str | None, typer.Option(help="With --gpu: Mitsuba variant (default: cuda_ad_rgb).")] = None,
) -> None:
    """Say what runs on this machine, and the way out for what does not."""
    from rich.console import Console

    if gpu:
        from pathreplay.testing.gpu import examine as examine_gpu

        typer.echo(examine_gpu(variant, output, tell=typer.echo))
        return
    with interrupts.undisturbed():  # as in `optimize`
        from pathreplay.doctor import examine

    with Console(stderr=True).status("Trying every libLLVM and every variant ..."):
        report = examine()
    report.print()
    raise typer.Exit(0 if report.works else 1)


@app.command(short_help="Compare gradients with finite differences.")
def check(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or a built-in scene such as cornell-box.")],
    param: Annotated[list[str], typer.Option(metavar="KEY", help="Parameter key or glob; may be given several times.")],
    integrator: Annotated[
        str | None, typer.Option(help="Plugin to test (default: the scene's, if made for gradients; else pathreplay).")
    ] = None,
    seeds: Annotated[int, typer.Option(help="Independent seeds.")] = 16,
    spp: Annotated[int, typer.Option(help="Samples per pixel of a gradient.")] = 16,
    fd_spp: Annotated[int | None, typer.Option(help="Samples per pixel of a difference (default: --spp).")] = None,
    step: Annotated[float | None, typer.Option(help="Step of the differences (default: 1 % of the parameter).")] = None,
    max_depth: Annotated[int | None, typer.Option(help="Path length (default: the scene's).")] = None,
    boundary: Annotated[
        Literal["auto", "none", "primary", "all"] | None,
        typer.Option(help="Boundary terms of 'pathreplay' (default: the scene's, else auto: where edges move)."),
    ] = None,
    boundary_spp: Annotated[int | None, typer.Option(help="Boundary segments per pixel (default: --spp).")] = None,
    mode: Annotated[
        Literal["backward", "forward"], typer.Option(help="Derivative of the loss, or of the picture.")
    ] = "backward",
    sensor: Annotated[int, typer.Option(help="Index of the sensor.")] = 0,
    seed: Annotated[int, typer.Option(help="Chooses all random numbers.")] = 0,
    variant: Annotated[str | None, typer.Option(help="Mitsuba variant (default: the best that runs here).")] = None,
    json: Annotated[Path | None, typer.Option(help="Also write the results, samples included, to this file.")] = None,
) -> None:
    """Compare gradients with finite differences of Mitsuba's path tracer; exit status 1 if one does not pass."""
    with interrupts.undisturbed():  # as in `optimize`
        from pathreplay.platform import backend
        from pathreplay.scenes.loading import load_scene_for
        from pathreplay.testing import command

    if json is not None:
        command.require_writable(json)
    with interrupts.undisturbed():
        backend.set_variant(variant)
    loaded, notes = load_scene_for(scene, param)
    for note in notes:
        typer.echo(f"pathreplay: {plain_line(note)}", err=True)
    asked = {"boundary": boundary, "boundary_spp": boundary_spp}
    asked = {name: value for name, value in asked.items() if value is not None}
    checks = command.check_all(
        loaded, param, integrator=integrator, seeds=seeds, spp=spp, fd_spp=fd_spp, step=step,
        max_depth=max_depth, boundary=asked, mode=mode, sensor=sensor, seed=seed,
    )  # fmt: skip
    results = command.print_checks(checks)
    if json is not None:
        command.write_checks(results, json)
    raise typer.Exit(0 if all(result.passed for result in results) else 1)


@app.command(short_help="Recover scene parameters from pictures.")
def optimize(
    config: Annotated[Path | None, typer.Argument(help="Job in TOML or YAML; see docs/optimize.md.")] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="RUN_FOLDER", help="Go on with an unfinished run instead.")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Run folder to make; default: runs/<name of the config>.")] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change the job, as in --set spp=32; may be repeated."),
    ] = None,
    define: Annotated[list[str] | None, typer.Option("--define", "-D", hidden=True)] = None,
    executor: Annotated[
        Literal["local", "ray"] | None,
        typer.Option(help="Who computes: this process, or actors of Ray (default: as the job says)."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress on the screen.")] = False,
) -> None:
    """Recover scene parameters from pictures; Ctrl-C or SIGTERM ends early with everything written."""
    if define:
        raise PathreplayError(f"-D is for scene parameters; change a job with: --set {define[0]}")
    with interrupts.undisturbed():  # what is half imported can bring the process down at its end
        from pathreplay.jobs import optimize as run_job

    result = run_job(config, resume=resume, output=output, progress=not quiet, define=changes or (), executor=executor)
    typer.echo(result.describe())


@app.command(short_help="Follow a run in the browser.")
def watch(
    run: Annotated[Path, typer.Argument(help="Run folder, of a run under way or of one that has ended.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to serve at; 0: any that is free.")] = 0,
    host: Annotated[str, typer.Option(help="Address to serve at; others than loopback are seen by others.")] = (
        "127.0.0.1"
    ),
) -> None:
    """Serve a page that follows a run, with a button to stop it; Ctrl-C ends the command, and not the run."""
    with interrupts.undisturbed():
        from pathreplay.report.watch.run_files import require_run
        from pathreplay.report.watch.server import RunServer, serve

    require_run(run)
    server = RunServer(run, host, port)
    typer.echo(f"{server.address}\nWho has this address can look at the run and stop it. Ctrl-C ends this command.")
    try:
        serve(server)
    except interrupts.Interrupted as ended:
        if ended.number != signal.SIGINT:
            raise


commands.add_to(app)


@app.command(short_help="Render a scene into a picture.")
def render(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or a built-in scene such as cornell-box.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="Picture to write: .exr or .png.")],
    integrator: Annotated[
        str | None, typer.Option(help="Plugin that renders, Mitsuba's or ours (default: the scene's).")
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option("--option", "-I", metavar="NAME=VALUE", help="Of the integrator, as in -I max_depth=8."),
    ] = None,
    sensor: Annotated[str | None, typer.Option(help="Id or number of the sensor (default: the first).")] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="In pixels; WIDTH alone keeps the proportions.")
    ] = None,
    spp: Annotated[int | None, typer.Option(help="Samples per pixel (default: the sensor's).")] = None,
    seed: Annotated[int, typer.Option(help="Chooses all random numbers.")] = 0,
    define: Annotated[
        list[str] | None,
        typer.Option("--define", "-D", metavar="NAME=VALUE", help="Scene parameter, as in -D res=64."),
    ] = None,
    variant: Annotated[str | None, typer.Option(help="Mitsuba variant (default: the best that runs here).")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress on the screen.")] = False,
) -> None:
    """Render a scene by any integrator into one file, which is there whole or not at all."""
    with interrupts.undisturbed():  # as in `optimize`
        from pathreplay.output.render import render_to_file
        from pathreplay.platform import backend

        backend.set_variant(variant)
    line = render_to_file(
        scene, output, integrator=integrator, options=option or (), sensor=sensor, size=size, spp=spp, seed=seed,
        define=define or (), progress=not quiet,
    )  # fmt: skip
    typer.echo(line)


@app.command(short_help="Write out what a run recovered.")
def export(
    run: Annotated[Path, typer.Argument(help="Run folder that optimize has made.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="New folder; default: RUN/export.")
    ] = None,
) -> None:
    """Write out what a run recovered: textures, volumes, meshes, cameras, and the scene as Mitsuba XML."""
    with interrupts.undisturbed():  # as in `optimize`
        from pathreplay.output.export import export_run

    typer.echo(export_run(run, output))


@app.command(short_help="Print the JSON schema of a job.")
def schema(
    markdown: Annotated[bool, typer.Option("--markdown", help="A page of all keys instead, as Markdown.")] = False,
) -> None:
    """Print the JSON schema of a job: editors complete and check configs with it."""
    import json

    from pathreplay.inverse.config.reference import reference
    from pathreplay.inverse.config.schema import Config

    if markdown:
        typer.echo(reference(), nl=False)
        return

    typer.echo(json.dumps(Config.model_json_schema(), indent=2))


_CHECKOUT = Path(__file__).resolve().parents[2]
_HAS_BENCHMARKS = (_CHECKOUT / "benchmarks" / "__main__.py").is_file()


# The options are those of `python -m benchmarks`, which prints its own help. It runs where the user is: files that are
# named on the command line are found from there. The wheel holds no benchmarks, so its help does not show the command.
@app.command(
    short_help="Measure time, memory, noise and truth.",
    hidden=not _HAS_BENCHMARKS,
    add_help_option=False,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
)
def bench(context: typer.Context) -> None:
    """Measure time, memory, noise and truth next to Mitsuba's own integrators; needs a checkout."""
    if not _HAS_BENCHMARKS:
        raise PathreplayError(
            "the benchmarks are not part of the installed package: they are the folder 'benchmarks' of the repository; "
            "clone it and run 'make bench' there"
        )
    paths = [str(_CHECKOUT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", "benchmarks", *context.args]
    raise typer.Exit(subprocess.run(command, env=environment).returncode)


def _require_text_and_folder(arguments: list[str]) -> None:
    try:
        for argument in arguments:
            argument.encode()
    except UnicodeEncodeError:  # Python's stand-ins for bytes that are no UTF-8, which no report or JSON can hold
        raise PathreplayError(f"argument '{argument}' is not UTF-8; rename the file or folder") from None
    try:
        os.getcwd()
    except OSError:  # Mitsuba would bring the process down
        raise PathreplayError("the current folder was removed; change to another and start again") from None


def _fail(message: str) -> NoReturn:
    # Plain stderr, one line: neither markup nor wrapping may touch a path or a parameter key.
    with contextlib.suppress(OSError):  # nobody can be told; the status still says it
        print("pathreplay: error: " + plain_line(message), file=sys.stderr)
    raise SystemExit(2)


def main() -> None:
    """Run the command line; the entry point `pathreplay`."""
    try:
        _run()
    except SystemExit as end:
        if (trouble := _let_go_of_streams()) and end.code != 2:  # with 2 one line has been said
            _fail(trouble)
        raise


def _let_go_of_streams() -> str:
    """Write out what is printed, while an error can still be told; Python's own ending would just say status 120.

    Returns why stdout could not be written, or "". What cannot be written is given up.
    """
    trouble = ""
    for stream in filter(None, (sys.stdout, sys.stderr)):  # one that was closed before is None
        try:
            stream.flush()
        except OSError as error:
            if stream is sys.stdout and error.errno != errno.EPIPE:  # whoever reads may have read enough
                trouble = f"the output cannot be written ({error.strerror}); send it elsewhere"
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return trouble


def _run() -> NoReturn:
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal without ± should not end a run
    try:
        with interrupts.raised():
            address_space.require()
            _require_text_and_folder(sys.argv[1:])
            status = app(sys.argv[1:] or ["--help"], prog_name="pathreplay", standalone_mode=False)
    except _UsageError as error:
        command = error.ctx.command_path if error.ctx else "pathreplay"
        _fail(f"{error.format_message().rstrip('.')}; see: {command} --help")
    except (KeyboardInterrupt, _Ended) as ended:
        _end(ended.__cause__ or ended)
    except PathreplayError as error:
        _fail(str(error))
    except ImportError as error:
        if not (line := address_space.told(error)):
            raise
        _fail(line)
    except MemoryError:
        _fail("out of memory: lower the resolution, the samples per pixel or the number of views")
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        _fail(f"no space left on the disk for {error.filename or 'the output'}: free some space, or write elsewhere")
    raise SystemExit(status)


if __name__ == "__main__":
    main()

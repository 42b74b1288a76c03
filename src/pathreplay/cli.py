"""The command line: each command parses its arguments, calls the package that does the work, and prints the result.

Exit status 0 means success, 1 a negative result (a gradient fails its check, or no variant runs on this machine), and 2
an error that the user has to fix. If a signal ends the command, the status is 128 plus the signal number (130 for
Ctrl-C). `optimize` is an exception: after a signal, it writes its results and exits with 0. Heavy modules are imported
inside the commands, so that `pathreplay --help` responds immediately.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import shlex
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
"""Base class of typer's errors for an invalid command line; typer exports only one of its subclasses."""


class _Ended(BaseException):
    """Wraps a KeyboardInterrupt for `_run`, because typer would handle the KeyboardInterrupt itself."""


class _Commands(typer.core.TyperGroup):
    """Converts a KeyboardInterrupt to `_Ended`, because typer would print its own message and exit."""

    def invoke(self, ctx: Any) -> object:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as interrupt:
            raise _Ended from interrupt


def _end(interrupt: BaseException) -> NoReturn:
    for number in interrupts.ENDING:
        signal.signal(number, signal.SIG_IGN)  # a second signal must not interrupt the exit
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"pathreplay: {str(interrupt) or 'ended by Ctrl-C'}", file=sys.stderr, flush=True)
    raise SystemExit(128 + getattr(interrupt, "number", signal.SIGINT))


app = typer.Typer(
    name="pathreplay",
    cls=_Commands,
    help="Differentiable light transport on Mitsuba 3: check gradients, recover scenes from images.",
    rich_markup_mode=None,  # typer's panels would show a flag as if it took a value: "--quiet <bool>"
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
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Parse the options that precede a command."""


@app.command(short_help="Report what runs on this machine.")
def doctor(
    gpu: Annotated[
        bool, typer.Option("--gpu", help="Run gradient checks and timings on the GPU, and write a file.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="With --gpu: file to write (default: pathreplay-gpu.json)."
        ),
    ] = None,
    variant: Annotated[str | None, typer.Option(help="With --gpu: Mitsuba variant (default: cuda_ad_rgb).")] = None,
) -> None:
    """Report what runs on this machine, and the remedy for what does not."""
    from rich.console import Console

    if not gpu and (output or variant):
        raise PathreplayError(f"{'--output' if output else '--variant'} needs --gpu; add --gpu, or leave it out")
    output = output or Path("pathreplay-gpu.json")
    if gpu:
        from pathreplay.testing.gpu import examine as examine_gpu

        summary, wrong = examine_gpu(variant, output, tell=typer.echo)
        typer.echo(summary)
        raise typer.Exit(1 if wrong else 0)
    with interrupts.undisturbed():  # signals must not interrupt imports; see `optimize`
        from pathreplay.doctor import examine

    with Console(stderr=True).status("Trying every libLLVM and every variant ..."):
        report = examine()
    report.print()
    raise typer.Exit(0 if report.works else 1)


@app.command(short_help="Compare gradients with finite differences.")
def check(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or a built-in scene such as cornell-box.")],
    param: Annotated[list[str], typer.Option(metavar="KEY", help="Parameter key or glob; may be repeated.")],
    integrator: Annotated[
        str | None, typer.Option(help="Plugin to test (default: the scene's, if differentiable; else pathreplay).")
    ] = None,
    seeds: Annotated[int, typer.Option(help="Number of independent seeds.")] = 16,
    spp: Annotated[int, typer.Option(help="Samples per pixel of a gradient.")] = 16,
    fd_spp: Annotated[
        int | None, typer.Option(help="Samples per pixel of a finite difference (default: --spp).")
    ] = None,
    step: Annotated[
        float | None, typer.Option(help="Step of the finite differences (default: 1 % of the parameter).")
    ] = None,
    max_depth: Annotated[int | None, typer.Option(help="Maximum path depth (default: the scene's).")] = None,
    boundary: Annotated[
        Literal["auto", "none", "primary", "all"] | None,
        typer.Option(help="Boundary terms of 'pathreplay' (default: the scene's, else auto: if occluders move)."),
    ] = None,
    boundary_spp: Annotated[int | None, typer.Option(help="Boundary segments per pixel (default: --spp).")] = None,
    mode: Annotated[
        Literal["backward", "forward"], typer.Option(help="Derivative of the loss (backward) or the image (forward).")
    ] = "backward",
    sensor: Annotated[int, typer.Option(help="Index of the sensor.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    variant: Annotated[str | None, typer.Option(help="Mitsuba variant (default: the best that runs here).")] = None,
    json: Annotated[Path | None, typer.Option(help="Also write results and samples to this JSON file.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Also draw derivative images beside finite differences (PNG, PDF or SVG).")
    ] = None,
) -> None:
    """Compare gradients with finite differences of images; exit status 1 if a check fails."""
    with interrupts.undisturbed():  # signals must not interrupt imports; see `optimize`
        from pathreplay.platform import backend
        from pathreplay.platform.atomic_files import require_writable, write_whole
        from pathreplay.scenes.loading import load_scene_for
        from pathreplay.testing import command

    if json is not None:
        require_writable(json, "--json")
    if picture is not None:
        command.require_picture(picture)
        require_writable(picture, "--picture")
    with interrupts.undisturbed():
        backend.set_variant(variant)
    loaded, notes = load_scene_for(scene, param)
    for note in notes:
        typer.echo(f"pathreplay: {plain_line(note)}", err=True)
    options = {"boundary": boundary, "boundary_spp": boundary_spp}
    options = {name: value for name, value in options.items() if value is not None}
    checks = command.check_all(
        loaded, param, integrator=integrator, seeds=seeds, spp=spp, fd_spp=fd_spp, step=step,
        max_depth=max_depth, boundary=options, mode=mode, sensor=sensor, seed=seed,
    )  # fmt: skip
    results = command.print_checks(checks)
    if json is not None:
        command.write_checks(results, json)
    if picture is not None:
        from pathreplay.report.derivatives import derivatives_figure

        rows = command.pictured(
            loaded, [result.key for result in results], integrator=integrator, seeds=seeds, spp=spp, fd_spp=fd_spp,
            step=step, max_depth=max_depth, boundary=options, sensor=sensor, seed=seed,
        )  # fmt: skip
        write_whole(picture, derivatives_figure(rows, command.format_of(picture)), "--picture")
    raise typer.Exit(0 if all(result.passed for result in results) else 1)


@app.command(short_help="Recover scene parameters from images.")
def optimize(
    config: Annotated[Path | None, typer.Argument(help="Job in TOML or YAML; see docs/optimize.md.")] = None,
    resume: Annotated[Path | None, typer.Option(metavar="RUN_FOLDER", help="Resume an unfinished run instead.")] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FOLDER", help="Run folder to create (default: the job's, else runs/<config>)."
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override a job key, as in --set spp=32; may be repeated."),
    ] = None,
    define: Annotated[list[str] | None, typer.Option("--define", "-D", hidden=True)] = None,
    executor: Annotated[
        Literal["local", "ray"] | None,
        typer.Option(help="Evaluate in this process or by Ray actors (default: the job's)."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Show no progress.")] = False,
) -> None:
    """Recover scene parameters from images. Ctrl-C or SIGTERM ends the run early, with all results written."""
    if define:
        raise PathreplayError(f"-D is for scene parameters; change a job with: --set {define[0]}")
    with interrupts.undisturbed():  # a half-imported module can crash the process at its exit
        from pathreplay.jobs import optimize as run_job

    result = run_job(config, resume=resume, output=output, progress=not quiet, define=changes or (), executor=executor)
    typer.echo(result.describe())


@app.command(short_help="Recover a scene from photographs.")
def from_photos(
    folder: Annotated[Path, typer.Argument(help="Folder with a transforms.json or a COLMAP model, and the images.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="New folder; default: photos/<name>.")
    ] = None,
    mesh: Annotated[
        Path | None, typer.Option(metavar="FILE", help="PLY or OBJ of the geometry (default: a density grid).")
    ] = None,
    minutes: Annotated[float, typer.Option(help="Time limit, from which iterations follow.")] = 30.0,
    test_every: Annotated[int, typer.Option(metavar="N", help="The first and every N-th photo are test views.")] = 5,
    width: Annotated[
        int | None,
        typer.Option(help="Width of the compared images in pixels (default: images of about 46 000 pixels)."),
    ] = None,
    refine_poses: Annotated[bool, typer.Option("--refine-poses", help="Also optimise the poses.")] = False,
    no_run: Annotated[bool, typer.Option("--no-run", help="Only write the job.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Show no progress.")] = False,
) -> None:
    """Write a job that recovers a scene from photographs with poses, run it, and export the scene."""
    with interrupts.undisturbed():  # signals must not interrupt imports; see `optimize`
        from pathreplay.jobs import from_photos as write_job
        from pathreplay.jobs import optimize as run_job
        from pathreplay.output.export import export_run
        from pathreplay.output.surface_scene import export_surface

    def tell(line: str) -> None:
        typer.echo(f"pathreplay: {plain_line(line)}", err=True)

    output = Path("photos") / (folder.resolve().name or "scene") if output is None else output
    written = write_job(
        folder, output, mesh=mesh, minutes=minutes, test_every=test_every, width=width, refine_poses=refine_poses,
        tell=tell,
    )  # fmt: skip
    for note in written.notes:
        tell(note)
    typer.echo(f"job: {written.job}")
    if no_run:
        command = ["pathreplay", "optimize", str(written.job), "--output", str(output / "run")]
        typer.echo(f"run it with: {shlex.join(command)}")
        return
    result = run_job(written.job, output=output / "run", progress=not quiet)
    typer.echo(result.describe())
    typer.echo(export_run(result.folder) if mesh is not None else export_surface(result.folder))


@app.command(short_help="Follow a run in the browser.")
def watch(
    run: Annotated[Path, typer.Argument(help="Run folder of an active or finished run.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0: any free port.")] = 0,
    host: Annotated[
        str, typer.Option(help="Address to listen on; other machines can reach any but loopback addresses.")
    ] = "127.0.0.1",
) -> None:
    """Serve a page that follows a run, with a button to stop it; Ctrl-C ends this command, not the run."""
    with interrupts.undisturbed():
        from pathreplay.report.watch.run_files import require_run
        from pathreplay.report.watch.server import RunServer, serve

    require_run(run)
    server = RunServer(run, host, port)
    typer.echo(f"{server.address}\nAnyone with this address can view and stop the run. Ctrl-C ends this command.")
    try:
        serve(server)
    except interrupts.Interrupted as ended:
        if ended.number != signal.SIGINT:
            raise


commands.add_to(app)


@app.command(short_help="Render a scene to an image file.")
def render(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or a built-in scene such as cornell-box.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="Image file to write: .exr or .png.")],
    integrator: Annotated[
        str | None, typer.Option(help="Integrator plugin of Mitsuba or pathreplay (default: the scene's).")
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option("--option", "-I", metavar="NAME=VALUE", help="Integrator property, as in -I max_depth=8."),
    ] = None,
    sensor: Annotated[str | None, typer.Option(help="Id or index of the sensor (default: the first).")] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Size in pixels; WIDTH alone keeps the aspect ratio.")
    ] = None,
    spp: Annotated[int | None, typer.Option(help="Samples per pixel (default: the sensor's).")] = None,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    define: Annotated[
        list[str] | None,
        typer.Option("--define", "-D", metavar="NAME=VALUE", help="Scene parameter, as in -D res=64."),
    ] = None,
    variant: Annotated[str | None, typer.Option(help="Mitsuba variant (default: the best that runs here).")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Show no progress.")] = False,
) -> None:
    """Render a scene with any integrator to one file, which is written atomically."""
    with interrupts.undisturbed():  # signals must not interrupt imports; see `optimize`
        from pathreplay.output.render import RenderOptions, render_to_file
        from pathreplay.platform import backend

        backend.set_variant(variant)
    asked = RenderOptions(integrator, option or (), sensor, size, spp, seed, define or ())
    typer.echo(render_to_file(scene, output, asked, progress=not quiet))


@app.command(short_help="Export what a run recovered.")
def export(
    run: Annotated[Path, typer.Argument(help="Run folder that optimize has created.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="New folder; default: RUN/export.")
    ] = None,
) -> None:
    """Export what a run recovered: textures, volumes, meshes, cameras, and the scene as Mitsuba XML."""
    with interrupts.undisturbed():  # signals must not interrupt imports; see `optimize`
        from pathreplay.output.export import export_run

    typer.echo(export_run(run, output))


@app.command(short_help="Write out the examples.")
def examples(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="New folder.")] = Path("examples"),
) -> None:
    """Write the examples into a new folder: jobs with their scenes, scripts and explanations."""
    from pathreplay.output.examples import write_examples

    typer.echo(write_examples(folder))


@app.command(short_help="Print the JSON schema of a job.")
def schema(
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown page of all keys instead.")] = False,
) -> None:
    """Print the JSON schema of a job, with which editors complete and check configs."""
    import json

    from pathreplay.inverse.config.reference import reference
    from pathreplay.inverse.config.schema import Config

    if markdown:
        typer.echo(reference(), nl=False)
        return

    typer.echo(json.dumps(Config.model_json_schema(), indent=2))


_CHECKOUT = Path(__file__).resolve().parents[2]
_HAS_BENCHMARKS = (_CHECKOUT / "benchmarks" / "__main__.py").is_file()


# `python -m benchmarks` parses the options and prints its own help. It runs in the current folder, so that relative
# paths resolve as usual. The wheel contains no benchmarks, and its `pathreplay --help` omits the command.
@app.command(
    short_help="Measure time, memory, noise and correctness.",
    hidden=not _HAS_BENCHMARKS,
    add_help_option=False,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
)
def bench(context: typer.Context) -> None:
    """Compare time, memory, noise and correctness with Mitsuba's own integrators; needs a checkout."""
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
    except UnicodeEncodeError:  # bytes that are not UTF-8 became surrogates, which reports and JSON cannot contain
        raise PathreplayError(f"argument '{argument}' is not UTF-8; rename the file or folder") from None
    try:
        os.getcwd()
    except OSError:  # without a current folder, Mitsuba would crash the process at exit
        raise PathreplayError("the current folder was removed; change to another and start again") from None


def _fail(message: str) -> NoReturn:
    # Print plain text without wrapping: markup and line breaks could alter a path or a parameter key.
    with contextlib.suppress(OSError):  # stderr may be closed; the exit status still reports the error
        print("pathreplay: error: " + plain_line(message), file=sys.stderr)
    raise SystemExit(2)


def main() -> None:
    """Run the command line; the entry point `pathreplay`."""
    try:
        _run()
    except SystemExit as end:
        if (problem := _flush_streams()) and end.code != 2:  # with status 2, one error line was already printed
            _fail(problem)
        raise


def _flush_streams() -> str:
    """Flush stdout and stderr, and discard output that cannot be written.

    Returns why stdout could not be written, or "". Without this call, Python would flush the streams at exit, and
    would report a failure to write them only by exit status 120.
    """
    problem = ""
    for stream in filter(None, (sys.stdout, sys.stderr)):  # a stream that was closed at the start is None
        try:
            stream.flush()
        except OSError as error:
            if stream is sys.stdout and error.errno != errno.EPIPE:  # a reader may close a pipe early, as head does
                problem = f"the output cannot be written ({error.strerror}); redirect it elsewhere"
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return problem


def _run() -> NoReturn:
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal may be unable to print ±
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
        if not (line := address_space.describe_failure(error)):
            raise
        _fail(line)
    except MemoryError:
        _fail("out of memory: lower the resolution, the samples per pixel or the number of views")
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        _fail(f"no space left on the disk for {error.filename or 'the output'}; free some space, or write elsewhere")
    raise SystemExit(status)


if __name__ == "__main__":
    main()

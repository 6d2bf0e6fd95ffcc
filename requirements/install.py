"""`python install.py PIP REQUIREMENTS`: installs pinned requirements, says how far it is and how long it may take.

Plain Python, because it runs before anything is installed. Exits with pip's own status and its last lines on a failure.
"""

import re
import subprocess
import sys
import time

LINE_EVERY_S = 10.0


def main(pip: str, requirements: str) -> int:
    """Install; one line that is rewritten on a terminal, a line every ten seconds elsewhere."""
    with open(requirements, encoding="utf-8") as file:  # noqa: PTH123 as small as it can be
        total = sum(bool(re.match(r"[A-Za-z0-9]", line)) for line in file)
    print(f"installing {total} packages, once (pinned and hash-checked)", flush=True)
    command = [pip, "install", "--require-hashes", "--no-deps", "--progress-bar", "off", "-r", requirements]
    began = said = time.monotonic()
    lines: list[str] = []
    done = 0
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        for line in process.stdout or ():
            lines.append(line)
            done += line.startswith("Collecting ")
            now = time.monotonic()
            end = line.startswith("Installing collected")
            if sys.stdout.isatty() or end or now - said > LINE_EVERY_S:
                said = now
                left_s = (now - began) / max(done, 1) * (total - done)
                text = "  unpacking them" if end else f"  {done} of {total} here, about {left_s:.0f} s left"
                print(
                    f"\r{text:<60}" if sys.stdout.isatty() else text,
                    end="" if sys.stdout.isatty() else "\n",
                    flush=True,
                )
    print("\r" if sys.stdout.isatty() else "", end="")
    if process.returncode:
        sys.stderr.writelines(lines[-15:])
    else:
        print(f"installed in {time.monotonic() - began:.0f} s")
    return process.returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

"""What the library is made of and needs, as CycloneDX 1.6 on standard output.

.ci/sbom.py [EXTRA ...]: what is installed of the requirements, with those of extras;
exit code 1 if a licence is not permissive.
"""
import json
import re
import sys
from importlib.metadata import PackageNotFoundError, distribution

from packaging.requirements import Requirement

NAME = "pdavis-cv"
PERMISSIVE = re.compile(
    r"\b(MIT|BSD|Apache|ISC|PSF|Python Software Foundation|0BSD|Zlib|HPND|CC0)",
    re.IGNORECASE)
LOOKED_UP = {"imutils": "MIT"}
"""What a package's metadata leave out and its sources say."""


def licence(found):
    """Return what a distribution says of its licence, in its own words."""
    meta = found.metadata
    classified = [line.rpartition(" :: ")[2] for line in meta.get_all("Classifier", ())
                  if line.startswith("License ::")]
    stated = meta.get("License-Expression") or "; ".join(classified)
    stated = stated or (meta.get("License") or "").partition("\n")[0].strip()
    return stated or LOOKED_UP.get(meta["Name"].lower(), "not stated")


def needed(name, extras, known):
    """Add a distribution and what it requires to `known`; return it."""
    found = distribution(name)
    known.setdefault(found.metadata["Name"].lower(), (found, []))
    requires = known[found.metadata["Name"].lower()][1]
    for text in found.requires or ():
        one = Requirement(text)
        wanted = one.marker is None or any(
            one.marker.evaluate({"extra": extra}) for extra in ("", *extras))
        try:
            other = distribution(one.name) if wanted else None
        except PackageNotFoundError:
            continue        # of another system, or not installed
        if other is None:
            continue
        key = other.metadata["Name"].lower()
        if key not in requires and key != name:
            requires.append(key)
        if key not in known:
            needed(one.name, sorted(one.extras), known)
    return found


def component(found):
    """Return a distribution as CycloneDX has it."""
    name, version = found.metadata["Name"], found.version
    return {"type": "library", "bom-ref": name.lower(), "name": name,
            "version": version, "purl": f"pkg:pypi/{name.lower()}@{version}",
            "licenses": [{"license": {"name": licence(found)}}]}


def main(extras):
    """Print the list; return 1 if a licence is not one of those that we take."""
    known = {}
    ours = needed(NAME, extras, known)
    parts = [component(found) for key, (found, _) in sorted(known.items())
             if key != NAME]
    json.dump({
        "bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1,
        "metadata": {"component": component(ours)}, "components": parts,
        "dependencies": [{"ref": key, "dependsOn": sorted(requires)}
                         for key, (_, requires) in sorted(known.items())],
    }, sys.stdout, indent=1)
    print()
    refused = [one for one in parts if not PERMISSIVE.search(
        one["licenses"][0]["license"]["name"])]
    for one in refused:
        print(f"{one['name']}: {one['licenses'][0]['license']['name']}",
              file=sys.stderr)
    return int(bool(refused))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

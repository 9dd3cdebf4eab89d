"""What the library is made of and needs, as CycloneDX 1.6 on standard output.

.ci/sbom.py [EXTRA ...]: the requirements, with those of extras (default: of `all`);
exit code 1 if one is not installed, or if its metadata state a licence that is neither
permissive nor expected.  Licences are SPDX expressions, which are parsed.
"""
import json
import re
import sys
from importlib.metadata import PackageNotFoundError, distribution

from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

NAME = "pdavis-cv"
PERMISSIVE = {"0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0",
              "CC0-1.0", "HPND", "ISC", "MIT", "MIT-CMU", "PSF-2.0", "Python-2.0",
              "Unlicense", "Zlib"}
EXPECTED = {"certifi": {"MPL-2.0"}, "tqdm": {"MPL-2.0"}}
"""Licences that hold for a package's own files; docs/promises.md names them."""
CLASSIFIED = {
    "Apache Software License": "Apache-2.0", "BSD License": "BSD-3-Clause",
    "ISC License (ISCL)": "ISC", "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0"}
LOOKED_UP = {"apsw": "Zlib", "imutils": "MIT", "neuromorphic-drivers": "MIT",
             "partd": "BSD-3-Clause", "protobuf": "BSD-3-Clause",
             "slicerator": "BSD-3-Clause"}
"""What the file of a package's licence says, and its metadata do not as SPDX."""


def licence(found):
    """Return the SPDX expression of a distribution's metadata, None if there is none.

    Several classifiers all hold: which of them is a choice is not said.
    """
    meta = found.metadata
    classified = [line.rpartition(" :: ")[2] for line in meta.get_all("Classifier", ())
                  if line.startswith("License ::")]
    for stated in (LOOKED_UP.get(canonicalize_name(meta["Name"])),
                   meta.get("License-Expression"), meta.get("License"), " AND ".join(
                       CLASSIFIED.get(one, "LicenseRef-" + re.sub(r"\W+", "-", one))
                       for one in classified)):
        try:
            if stated:
                return str(canonicalize_license_expression(stated))
        except InvalidLicenseExpression:
            continue
    return None


def taken(expression, allowed):
    """Tell whether a canonical SPDX expression can be met by allowed licences alone."""
    words = re.findall(r"[()]|[^\s()]+", expression)

    def alternatives():
        found = all_of()
        while words and words[0] == "OR":
            words.pop(0)
            found = all_of() or found
        return found

    def all_of():
        found = single()
        while words and words[0] == "AND":
            words.pop(0)
            found = single() and found
        return found

    def single():
        word = words.pop(0)
        if word == "(":
            found = alternatives()
            words.pop(0)
            return found
        if words and words[0] == "WITH":    # an exception only adds permissions
            del words[:2]
        return word in allowed

    return alternatives()


def needed(extras):
    """Return what is required with extras, and the names that each of it requires."""
    found, requires = {}, {}
    waiting = [(NAME, extra) for extra in ("", *extras)]
    for name, extra in waiting:     # it grows
        found[name] = distribution(name)
        for one in map(Requirement, found[name].requires or ()):
            if one.marker is None or one.marker.evaluate({"extra": extra}):
                other = canonicalize_name(one.name)
                requires.setdefault(name, set()).add(other)
                waiting += [pair for pair in ((other, e) for e in ("", *one.extras))
                            if pair not in waiting]
    return found, requires


def component(name, found):
    """Return a distribution as CycloneDX has it."""
    return {"type": "library", "bom-ref": name, "name": found.metadata["Name"],
            "version": found.version, "purl": f"pkg:pypi/{name}@{found.version}",
            "licenses": [{"expression": licence(found) or "NOASSERTION"}]}


def main(extras):
    """Print the list; return 1 if a licence is not one of those that we take."""
    try:
        found, requires = needed(extras)
    except PackageNotFoundError as error:
        print(f"not installed: {error.name}", file=sys.stderr)
        return 1
    parts = {name: component(name, one) for name, one in sorted(found.items())}
    ours = parts.pop(NAME)
    json.dump({
        "bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1,
        "metadata": {"component": ours}, "components": list(parts.values()),
        "dependencies": [{"ref": name, "dependsOn": sorted(requires.get(name, ()))}
                         for name in sorted(found)],
    }, sys.stdout, indent=1)
    print()
    refused = {key: stated for key, one in parts.items() if not taken(
        stated := one["licenses"][0]["expression"],
        PERMISSIVE | EXPECTED.get(key, set()))}
    for key, stated in refused.items():
        print(f"{key}: {stated}", file=sys.stderr)
    return int(bool(refused))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:] or ["all"]))

"""Give the Python that dexkit runs in a CycloneDDS 0.10.x: ``dexkit setup-dds``.

The package index has wheels of cyclonedds 0.10 for few interpreters only; for the others its
binding is compiled against a CycloneDDS library of this machine.

=========================  =====================================================================
:mod:`.facts`              what is known of interpreter, environment, libraries, distribution
:mod:`.inspect_machine`    finds that out; changes nothing
:mod:`.plan`               decides from the facts what is to be done; no input or output
:mod:`.execute`            does it in a temporary folder; installing is its last step
:mod:`.pinned_wheel`       writes into a built wheel which library it loads, or the library itself
:mod:`.probe`              the child process that imports, and sends a message and gets it back
:mod:`.advice`             what to install, and what the output of a failed build means
:mod:`.process_runner`     child processes with a log, which end when dexkit is interrupted
=========================  =====================================================================

Root's rights are never asked for, and the system's own Python is left alone (PEP 668).
"""

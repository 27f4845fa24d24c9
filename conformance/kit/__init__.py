"""Run, record and judge: what turns a hand into a result.

* run: :mod:`~.plugin` (pytest), :mod:`~.suite_run`, :mod:`~.live`, :mod:`~.backend_processes`,
  :mod:`~.phased_script`; how well the machine did: :mod:`~.calibration`, :mod:`~.heartbeat`,
  :mod:`~.run_queue`, :mod:`~.processor_waits`.
* record: :mod:`~.recording` (hands), :mod:`~.robot`, :mod:`~.touch`, :mod:`~.decoding`;
  what a run writes beside the messages: :mod:`~.run_record`, :mod:`~.stimulus_record`,
  :mod:`~.recording_marks`.
* judge: :mod:`~.requirements`, :mod:`~.judge`, :mod:`~.verdicts`, :mod:`~.stories`,
  :mod:`~.state_faults`, :mod:`~.claims`,
  :mod:`~.provenance`, :mod:`~.measurement_error`, :mod:`~.rejudge`.
* arithmetic: :mod:`~.sums`, :mod:`~.median`, :mod:`~.excess`, :mod:`~.row_selection`.
* result: :mod:`~.results`, :mod:`~.result_file`, :mod:`~.plots`.
"""

"""The bridge between the towers: calibrate, deploy, verify, improve. The only place of both.

The way of the data, and the modules of each part of it::

    bench file     bench_view bench_remarks scales
    a card         session simulated at_work doctor inspect as_described card_law
    its settings   commissioning safekeeping axis_setup
    trajectory     commands motions campaigns approach pvt
    runs           calibrate axis sensors run_cut run_log
    captures       same_axis
    model          identification diagnosis prediction comparison alternatives other_ways
    beyond it      beyond_model rippling drive_lag late_scale swinging_bed loose_nut
    compensation   compensate foreseen computing dynamic_law static_map law_cost routes
    as a file      compensation_file compensation_text
    in counts      rendering backlash tables cam program
    controller     upload_flow upload_plan difference deploy standing sign_test
    off it again   removal owners motion_owners previews
    verification   verify verify_stored runs repeated kept_runs promises
    its figures    outcome static_check positioning_sheet ringing own_ringing
    its verdict    summing_up verification
    all of it      demo improve
"""

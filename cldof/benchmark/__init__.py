"""Benchmark: every method and setting on every device, accuracy beside time and memory; ``cldof bench``.

=============  =====================================================================================
`ladders`      what is measured: one line per method, one entry per setting
`cases`        scenes at a size, captured as the methods need them, and their references
`harness`      which rows there are, measured one by one, written after each, resumed after an interruption
`peers`        what a user would take instead, each in a process of its own, skipped visibly when absent
`record`       the JSON document; everything below is made from it alone
`analysis`     accumulation at equal error, tables
`plots`        accuracy versus time (matplotlib)
`page`         one self-contained HTML page
`command`      the command line
=============  =====================================================================================
"""

"""Published matchers of other projects behind this project's contract, to be measured beside ours."""

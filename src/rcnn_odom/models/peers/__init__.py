"""Published matchers of other projects with this project's interface, for comparison with ours."""

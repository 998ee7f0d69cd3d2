"""The control: open-loop inputs as a service; controllers that follow an estimate, pure; their registry."""

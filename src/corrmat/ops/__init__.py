"""Pure tensor functions: no module, config, file or device."""

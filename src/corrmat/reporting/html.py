"""Pages from the templates of this package: everything in them, nothing fetched."""

import jinja2

_ENVIRONMENT = jinja2.Environment(
    loader=jinja2.PackageLoader("corrmat.reporting"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
)


def render(template: str, **values: object) -> str:
    """Fill a template; a value that is missing is an error."""
    return _ENVIRONMENT.get_template(template).render(**values)

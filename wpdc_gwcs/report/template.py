"""The template of the page, a single file without external resources."""

__all__ = ["PAGE"]

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
:root { color-scheme: light dark; --text: #222; --quiet: #595959; --line: #ccc; --back: #fff;
  --shade: #f3f4f6; --bad: #a40000; --half: #7a4d00; --link: #0050a0; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e6e6e6; --quiet: #a9a9a9; --line: #4a4a4a; --back: #16181c; --shade: #22252b;
    --bad: #ff8a80; --half: #ffc46b; --link: #8ab8ff; }
  img { filter: invert(0.91) hue-rotate(180deg); }
}
body { font-family: system-ui, sans-serif; margin: 1.5em auto; max-width: 78em; padding: 0 1em;
  color: var(--text); background: var(--back); line-height: 1.4; }
a { color: var(--link); }
h2 { border-bottom: 1px solid var(--line); padding-bottom: 0.2em; margin-top: 1.8em; }
nav ul { columns: 14em; padding-left: 1.2em; margin: 0.5em 0; }
.scroll { overflow-x: auto; margin-bottom: 1em; }
table { border-collapse: collapse; font-size: 88%; }
th, td { border-bottom: 1px solid var(--line); padding: 0.25em 0.55em; text-align: right;
  vertical-align: top; font-variant-numeric: tabular-nums; }
th { background: var(--shade); vertical-align: bottom; }
th small { display: block; color: var(--quiet); font-weight: normal; }
th:first-child, td:first-child, .text { text-align: left; }
.text { overflow-wrap: anywhere; }
tr.failed td { color: var(--bad); }
tr.degraded td { color: var(--half); }
img { max-width: 100%; height: auto; background: #fff; border-radius: 3px; }
figure { margin: 0.8em 0; }
figcaption, .quiet { color: var(--quiet); font-size: 88%; }
details { margin: 0.35em 0; }
summary { cursor: pointer; padding: 0.15em 0; }
details[open] > summary { font-weight: bold; }
@media print { details > * { display: block; } nav { display: none; } }
</style>
</head>
<body>
{% macro show(table) %}<div class="scroll"><table>
<tr>{% for column in table.columns %}<th{% if column.text %} class="text"{% endif %}
{%- if column.width %} style="min-width: {{ column.width }}ch"{% endif %}>
{{- column.name }}{% if column.unit %}<small>{{ column.unit }}</small>{% endif -%}
</th>{% endfor %}</tr>
{% for row in table.rows %}<tr{% if row.status %} class="{{ row.status }}"{% endif %}>
{%- for cell in row.cells %}<td{% if table.columns[loop.index0].text %} class="text"{% endif %}>
{%- if loop.first and row.link %}<a href="#{{ row.link }}">{{ cell }}</a>
{%- else %}{{ cell }}{% endif -%}
</td>{% endfor %}</tr>
{% endfor %}</table></div>
{% endmacro %}{% macro draw(figure) %}<figure><img alt="{{ figure.alt }}" width="{{ figure.width }}"
 height="{{ figure.height }}" src="data:image/webp;base64,{{ figure.data }}">
{% if figure.caption %}<figcaption>{{ figure.caption }}</figcaption>{% endif %}</figure>
{% endmacro %}<h1>{{ title }}</h1>
<p>{{ counts }} Residuals are X'' - X_ref and Y'' - Y_ref in undistorted pixels; means and sigmas
are after 3-sigma clipping.</p>
<nav aria-label="Contents"><ul>
{% for entry in contents %}<li><a href="#{{ entry.id }}">{{ entry.title }}</a></li>
{% endfor %}</ul></nav>
{% if problems %}<h2 id="problems">Failed and degraded frames</h2>
<ul class="problems">
{% for one in problems %}<li>{% if one.id %}<a href="#{{ one.id }}">{{ one.frame }}</a>{% else %}{{
one.frame }}{% endif %}: {{ one.status }}{% if one.reason %}: {{ one.reason }}{% endif %}</li>
{% endfor %}</ul>
{% if more_problems %}<p class="quiet">{{ more_problems }} more are in the table of
<a href="#frames">frames</a>.</p>{% endif %}
{% endif %}<h2 id="detectors">Detectors</h2>
<p class="quiet">All frames of a detector together.</p>
{{ show(detectors) }}
{% for section in sections %}<h2 id="{{ section.id }}">{{ section.title }}</h2>
<p>{{ section.text }}</p>
{% for figure in section.figures %}{{ draw(figure) }}{% endfor %}{% endfor %}
<h2 id="frames">Frames</h2>
{% if left_out %}<p>These are the frames that failed or are degraded, and those with the largest
residuals; {{ left_out }} more are in <code>summary.ecsv</code>.</p>
{% endif %}{{ show(summary) }}
<details><summary>All columns of the summary</summary>
{{ show(everything) }}</details>
{% if frames %}<h2 id="each">Frame by frame</h2>
{% for section in frames %}<details id="{{ section.id }}"><summary>{{ section.title }}</summary>
{% if section.table %}{{ show(section.table) }}{% endif %}
{% for figure in section.figures %}{{ draw(figure) }}{% endfor %}</details>
{% endfor %}{% endif %}{% if settings %}<h2 id="settings">Settings</h2>
{% for table in settings %}{{ show(table) }}
{% endfor %}{% endif %}<script>
function unfold() {
  const at = location.hash && document.getElementById(location.hash.slice(1));
  if (at && at.tagName === "DETAILS") { at.open = true; at.scrollIntoView(); }
}
addEventListener("hashchange", unfold);
unfold();
</script>
</body>
</html>
"""

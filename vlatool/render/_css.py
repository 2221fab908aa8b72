"""The style of the HTML page: system fonts, tabular numerals, two themes, narrow screens and paper."""

LIGHT = """
--paper:#fcfcfb;--raised:#ffffff;--ink:#1a1d21;--muted:#565d66;--rule:#e2e4e7;--grid:#eceef0;--wash:#f3f5f7;
--chosen:#0063a8;--chosen-wash:#edf5fb;--base:#69717a;--limit:#a3162e;--limit-wash:#a3162e0d;--guess:#6b4d00;
--guess-wash:#fbf6e9;--guess-rule:#d9c48c;--c0:#b84a00;--c1:#00785a;--c2:#99407a;--c3:#7d6200;--c4:#00788a;--c5:#5a4fb0;
--pass:#0b6b3a;--pass-wash:#e4f4ea;--fail:#a3162e;--fail-wash:#fdebed;--inconclusive:#7a5200;
--inconclusive-wash:#fdf3dc;--info:#3d4a5c;--info-wash:#e9edf3;
"""

DARK = """
--paper:#14171a;--raised:#1a1e22;--ink:#e7e9ec;--muted:#a3acb5;--rule:#30363d;--grid:#262b31;--wash:#1f2429;
--chosen:#6bb8f7;--chosen-wash:#172a3a;--base:#9ba4ad;--limit:#ff8b98;--limit-wash:#ff8b9812;--guess:#e6c978;
--guess-wash:#26221a;--guess-rule:#6a5a2c;--c0:#f59a5e;--c1:#4fc79d;--c2:#e596c6;--c3:#d8ba4f;--c4:#55c8d6;--c5:#aba2f5;
--pass:#6fd39b;--pass-wash:#15301f;--fail:#ff8b98;--fail-wash:#391a1f;--inconclusive:#eec25f;
--inconclusive-wash:#33290f;--info:#b4c2d6;--info-wash:#232b36;
"""

BASE = """
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%;text-size-adjust:100%}
body{margin:0;background:var(--paper);color:var(--ink);font:15px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,
"Helvetica Neue","Noto Sans","Liberation Sans",Arial,sans-serif;font-variant-numeric:tabular-nums lining-nums;
overflow-wrap:break-word}
main{max-width:1060px;margin:0 auto;padding:44px 32px 72px}
h1{font-size:27px;line-height:1.22;letter-spacing:-.015em;margin:4px 0 18px;font-weight:650;text-wrap:balance}
h2{font-size:17px;line-height:1.3;margin:0;font-weight:640;letter-spacing:-.005em}
.more th,.more td{border-top:0}
h3{font-size:14px;margin:22px 0 8px;font-weight:620}
p{margin:0 0 8px;max-width:76ch}
a{color:var(--chosen)}
section{margin-top:44px}
.over{font-size:13px;color:var(--muted)}
.sub{font-size:13px;color:var(--muted);margin:3px 0 14px;max-width:90ch}
.sub:last-child{margin-bottom:0}
.result{display:flex;gap:14px;align-items:baseline;margin-bottom:10px}
.result p{font-size:18px;line-height:1.45;margin:0}
.badge{flex:none;font-size:13px;font-weight:680;letter-spacing:.05em;text-transform:uppercase;padding:4px 11px;
border-radius:5px}
.pass{color:var(--pass);background:var(--pass-wash)}.fail{color:var(--fail);background:var(--fail-wash)}
.inconclusive{color:var(--inconclusive);background:var(--inconclusive-wash)}
.info{color:var(--info);background:var(--info-wash)}
.limits{display:flex;flex-wrap:wrap;gap:6px 8px;margin:16px 0 0;padding:0;list-style:none;font-size:13px}
.limits li{border:1px solid var(--rule);border-radius:5px;padding:2px 9px;background:var(--raised)}
.limits li:first-child{border-color:transparent;background:none;padding-left:0}
.limits span{color:var(--muted)}
.kind{display:inline-block;font-size:11px;font-weight:680;letter-spacing:.06em;text-transform:uppercase;
padding:1px 7px;border-radius:4px;margin-right:8px;vertical-align:2px;border:1px solid var(--rule);color:var(--muted)}
code,pre{font:13px/1.5 ui-monospace,SFMono-Regular,Menlo,Consolas,"Liberation Mono",monospace}
pre{background:var(--wash);border-radius:6px;padding:12px 14px;margin:0;white-space:pre-wrap}
"""

TABLES = """
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:14px}
caption{text-align:left;font-weight:620;padding:0 0 6px}
th,td{text-align:left;padding:7px 14px 7px 0;vertical-align:baseline;border-bottom:1px solid var(--rule)}
th{font-weight:560}
thead th{font-size:12.5px;color:var(--muted);border-bottom-color:var(--muted);vertical-align:bottom}
tbody th{font-weight:560}
th.n,td.n{text-align:right;padding:7px 0 7px 16px}
th.n+th:not(.n),td.n+td:not(.n){padding-left:16px}
td.n>span:first-child{white-space:nowrap}
.aside{display:block;font-size:12px;line-height:1.4;color:var(--muted);font-weight:400}
.aside b{font-weight:400;white-space:nowrap}
.none{color:var(--muted);font-style:italic}
.variants td,.variants th{border-bottom:0;padding-top:11px;padding-bottom:2px}
.variants thead th{padding-bottom:7px;border-bottom:1px solid var(--muted)}
.variants .why td{padding:0 14px 11px 12px;border-bottom:1px solid var(--rule);font-size:13px;color:var(--muted);
max-width:0}
.variants tbody th,.variants thead th:first-child{padding-left:12px}
.variants td:last-child{padding-right:12px}
.variants thead th:last-child{padding-right:12px}
.variants tbody th{font-size:15px;font-weight:620;min-width:120px}
.chosen-row{background:var(--chosen-wash);box-shadow:inset 3px 0 var(--chosen)}
.role{font-weight:620;color:var(--ink)}.chosen-row .role{color:var(--chosen)}
.key{display:inline-block;width:9px;height:9px;border-radius:2px;margin-right:8px;background:currentColor}
.bar{display:block;position:relative;height:7px;min-width:110px;margin:5px 0 4px;
background:var(--grid);border-radius:2px}
.bar i{position:absolute;inset:0 auto 0 0;background:currentColor;border-radius:2px;opacity:.85}
.bar u{position:absolute;top:-2px;bottom:-2px;border:1px solid var(--ink);border-width:0 1px;opacity:.8;min-width:2px}
.bar u::after{content:"";position:absolute;left:0;right:0;top:5px;border-top:1px solid var(--ink)}
.bar s{position:absolute;top:-4px;bottom:-4px;border-left:2px solid var(--limit)}
.small{table-layout:fixed;min-width:520px}.small .bar{min-width:60px;height:5px}
.groups tbody td{border-bottom:0;border-top:1px solid var(--rule)}.groups tbody .same td{border-top:0;padding-top:0}
.groups tbody tr:first-child td{border-top:0}.groups{border-bottom:1px solid var(--rule)}
.pairs{display:grid;grid-template-columns:repeat(auto-fill,minmax(250px,1fr));gap:6px 28px;margin:0;font-size:13.5px}
.pairs dt{color:var(--muted);font-size:12px}.pairs dd{margin:0}
.trust{margin:16px 0 0;padding:11px 16px;border-left:3px solid var(--info);background:var(--wash);
border-radius:0 5px 5px 0;max-width:90ch}
.trust.suspect{border-color:var(--inconclusive);background:var(--inconclusive-wash)}
.trust.invalid{border-color:var(--fail);background:var(--fail-wash)}.trust.valid{border-color:var(--pass)}
.trust p{margin:0;font-weight:620}.trust ul{margin:6px 0 0;padding:0;list-style:none;font-size:14px}
.trust li{margin-top:5px}.trust li b{font-weight:620;margin-right:4px}.trust b.note{color:var(--muted)}
.trust b.suspect{color:var(--inconclusive)}.trust b.invalid{color:var(--fail)}.remedy{display:block;color:var(--muted)}
.sides{display:grid;grid-template-columns:1fr 1fr;gap:14px;margin:14px 0}
.sides>div{border:1px solid var(--rule);border-radius:8px;padding:13px 16px;background:var(--raised)}
.sides>.guess{border:1px dashed var(--guess-rule);background:var(--guess-wash)}
.sides p{font-size:13px;color:var(--muted);margin:0 0 6px}.sides dl{margin:0}
.sides dl div{display:grid;grid-template-columns:minmax(90px,34%) 1fr;gap:0 12px;padding:2px 0}
.sides dt{color:var(--muted);font-size:13px}.sides dd{margin:0;font-weight:620}
.percentiles{width:auto;min-width:min(100%,420px)}.percentiles .bound{color:var(--muted)}
.percentiles .why{color:var(--muted);font-size:12.5px;font-style:italic;max-width:46ch}
.percentiles .begin{padding-left:30px}
.percentiles .over th,.percentiles .over td{border-bottom:0;padding-bottom:0}
.groups thead td{border-bottom:1px solid var(--muted)}
.parts td:last-child{width:42%;min-width:80px;padding-right:0;padding-left:18px;vertical-align:top}
.parts .whose{white-space:nowrap}
.parts .bar{min-width:60px;height:9px;margin:6px 0 0;background:none}
.guess{border:1px dashed var(--guess-rule);border-radius:8px;background:var(--guess-wash);padding:20px 22px}
.guess .kind{color:var(--guess);border-color:var(--guess-rule)}
.guess th,.guess td,.guess thead th{border-color:var(--guess-rule)}
.notes{margin:12px 0 0;padding-left:18px;font-size:13px;color:var(--muted)}
.warn{margin:12px 0 0;padding:0;list-style:none}
.warn li{padding:9px 14px;margin-bottom:6px;border-left:3px solid var(--inconclusive);
background:var(--inconclusive-wash);border-radius:0 5px 5px 0}
"""

CHARTS = """
.chart{display:block;max-width:100%;height:auto;margin-top:4px}
.narrow{display:none}
.chart text{font:11.5px system-ui,-apple-system,"Segoe UI",Roboto,"Liberation Sans",Arial,sans-serif;fill:var(--ink);
font-variant-numeric:tabular-nums}
.chart .tick,.chart .note{fill:var(--muted)}.chart .name{font-weight:600}
.grid{stroke:var(--grid)}.axis{stroke:var(--rule)}
.chart .ink{fill:var(--series)}
.s-base{--series:var(--base)}.s-chosen{--series:var(--chosen)}
.s0{--series:var(--c0)}.s1{--series:var(--c1)}.s2{--series:var(--c2)}.s3{--series:var(--c3)}.s4{--series:var(--c4)}
.s5{--series:var(--c5)}
.key,.bar{color:var(--series,var(--base))}
.line{stroke:var(--series);stroke-width:1.6;stroke-linejoin:round}
.line.s-chosen{stroke-width:2.4}.line.s-base{stroke-dasharray:6 3}.line.s1{stroke-dasharray:9 2 2 2}
.line.s2{stroke-dasharray:3 2}.line.s3{stroke-dasharray:11 3}.line.s4{stroke-dasharray:1.5 2.5}
.fill{fill:var(--series);opacity:.62}.outer{fill:var(--series);opacity:.13}.band{fill:var(--series);opacity:.26}.band~.line{stroke-dasharray:none}
.mark{stroke:var(--series);stroke-width:2}.whisker{stroke:var(--series);stroke-width:1.5;opacity:.65}
.dot{fill:var(--series);stroke:var(--paper);stroke-width:1}.hollow{fill:var(--paper);stroke:var(--series);stroke-width:2}
.leader{stroke:var(--series);stroke-width:1;opacity:.8}
.ring{fill:none;stroke:var(--series);stroke-width:1.5}
.limit{stroke:var(--limit);stroke-width:1.4;stroke-dasharray:5 3}.chart .limit-text{fill:var(--limit)}
.outside{fill:var(--limit-wash)}.front{stroke:var(--muted);stroke-width:1;stroke-dasharray:2 3}
.s-gauge{--series:var(--muted)}.line.s-gauge{stroke-width:1.2}
.throttle{stroke:var(--limit);stroke-width:1;opacity:.55}
.halo{paint-order:stroke;stroke:var(--paper);stroke-width:3.5px;stroke-linejoin:round}
"""

NARROW = """
@media screen and (max-width:700px){
.sides{grid-template-columns:1fr}
main{padding:26px 16px 48px}h1{font-size:22px}section{margin-top:36px}
.result{flex-direction:column;gap:8px}.result p{font-size:16px}
.wide{display:none}.narrow{display:block}
.guess{padding:16px 14px}
.percentiles .begin{padding-left:16px}
.parts .calls{display:none}.parts{font-size:13px}.parts td,.parts th{padding-right:9px}
.parts td.n,.parts th.n{padding-left:6px}
.parts td:last-child{width:22%;min-width:56px;padding-left:10px}.parts .bar{min-width:46px}
.variants,.variants tbody,.variants tr,.variants th,.variants td{display:block}
.variants thead{position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%)}
.variants tbody{padding:10px 12px;border-bottom:1px solid var(--rule)}
.variants tbody th{padding:0 0 4px}
.variants tbody td:not(.gap){display:grid;grid-template-columns:minmax(110px,42%) 1fr;column-gap:12px;padding:3px 0;
text-align:left;white-space:normal}
.variants td::before{content:attr(data-label);color:var(--muted);font-size:13px;grid-row:1/span 4}
.variants td>*{grid-column:2}.variants .gap{display:none}
.variants tbody .why td{display:block;max-width:none;border:0;padding:4px 0 2px}
}
@media print{
body{font-size:11px;background:#fff}main{max-width:none;padding:0}section{margin-top:22px}
.key,.bar,.bar i,.badge,.chosen-row,.guess,.warn li,.chart *{print-color-adjust:exact;-webkit-print-color-adjust:exact}
svg,tr,.guess,.warn li{break-inside:avoid}h2,h3{break-after:avoid}.scroll{overflow:visible}
}
"""


def stylesheet() -> str:
    """Return the whole style; paper is always light."""
    root = f":root{{color-scheme:light dark;{LIGHT}}}"
    dark = f"@media screen and (prefers-color-scheme:dark){{:root{{{DARK}}}}}"
    return "".join((root, dark, BASE, TABLES, CHARTS, NARROW)).replace("\n", "")

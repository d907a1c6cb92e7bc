//! A sweep as a drawing: the first measure over CPU time, the Pareto front marked.

use super::Sweep;
use crate::{Error, ErrorKind, Result};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// Pixels; an SVG scales.
const SIZE: (u32, u32) = (760, 440);

/// One for each series, told apart in gray and by the color-blind (Okabe, Ito 2008).
const COLORS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(90, 90, 90),
];

/// Returns the drawing as an SVG file, on white.
pub(super) fn svg(sweep: &Sweep) -> Result<String> {
    let mut out = String::new();
    draw(sweep, &mut out).map_err(|e| Error::new(ErrorKind::Bug, format!("sweep `{}`: {e}", sweep.name)))?;
    Ok(out)
}

fn draw(sweep: &Sweep, out: &mut String) -> std::result::Result<(), Box<dyn std::error::Error>> {
    let points: Vec<(usize, f64, f64, bool)> = sweep
        .rows
        .iter()
        .zip(sweep.front())
        .enumerate()
        .filter_map(|(i, (row, front))| {
            let (x, y) = (sweep.time(row).max(1e-7), row.figures.first().copied()??);
            y.is_finite().then_some((i, x, y, front))
        })
        .collect();
    let span = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
    };
    let (x0, x1) = span(&mut points.iter().map(|p| p.1));
    let (y0, y1) = span(&mut points.iter().map(|p| p.2));
    // room for the words beside the points
    let (left, right) = (x0 / (x1 / x0).powf(0.06).max(1.15), x1 * (x1 / x0).powf(0.3).max(1.6));
    let margin = 0.12 * (y1 - y0).max(1e-3 * y1.abs()).max(1e-9);
    let mut series: Vec<&str> = Vec::new();
    for row in &sweep.rows {
        if !series.contains(&row.series.as_str()) {
            series.push(&row.series);
        }
    }
    let root = SVGBackend::with_string(out, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .caption(&sweep.title, ("sans-serif", 20))
        .margin(12)
        // the last time may reach beyond the axis
        .margin_right(40)
        .x_label_area_size(44)
        .y_label_area_size(64)
        .build_cartesian_2d(
            (left..right).log_scale().with_key_points(ticks(left, right)),
            (y0 - margin)..(y1 + margin),
        )?;
    let measure = &sweep.measures[0];
    let more = measure.more_is_better == Some(true);
    let better = if more { "more is better" } else { "less is better" };
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .bold_line_style(RGBColor(226, 226, 226))
        .x_desc(if sweep.by_wall { "seconds (fewer are better)" } else { "CPU seconds (fewer are better)" })
        .y_desc(format!("{} ({better})", measure.name))
        .x_label_formatter(&|v| super::short_time(*v))
        .y_label_formatter(&|v| short(*v))
        .label_style(("sans-serif", 14))
        .draw()?;
    for (k, name) in series.iter().enumerate() {
        let color = COLORS[k % COLORS.len()];
        let own: Vec<_> = points.iter().filter(|p| sweep.rows[p.0].series == *name).collect();
        let line = LineSeries::new(own.iter().map(|p| (p.1, p.2)), color.mix(0.45).stroke_width(1));
        let drawn = chart.draw_series(line)?;
        if !name.is_empty() && series.len() > 1 {
            drawn.label(*name).legend(move |(x, y)| Circle::new((x + 8, y), 4, color.filled()));
        }
        for &&(i, x, y, front) in &own {
            chart.draw_series([Circle::new((x, y), 4, color.filled())])?;
            if front {
                chart.draw_series([Circle::new((x, y), 8, color.stroke_width(2))])?;
            }
            // words of neighbors stand above and below in turn
            let below = i % 2 == 1;
            let place = Pos::new(HPos::Left, if below { VPos::Top } else { VPos::Bottom });
            let style = ("sans-serif", 12).into_font().color(&RGBColor(70, 70, 70)).pos(place);
            let word = Text::new(sweep.rows[i].choice.clone(), (8, if below { 5 } else { -5 }), style);
            chart.draw_series([EmptyElement::at((x, y)) + word])?;
        }
    }
    if series.len() > 1 {
        chart
            .configure_series_labels()
            // away from where time buys most
            .position(if more { SeriesLabelPosition::LowerRight } else { SeriesLabelPosition::UpperRight })
            .label_font(("sans-serif", 13))
            .background_style(WHITE.mix(0.85))
            .border_style(RGBColor(226, 226, 226))
            .draw()?;
    }
    root.present()?;
    Ok(())
}

/// Times to name between two of them: 1, 2 and 5 of each decade, or all digits where those are few.
fn ticks(from: f64, to: f64) -> Vec<f64> {
    let (first, last) = (from.log10().floor() as i32, to.log10().ceil() as i32);
    let of = |digits: &[i32]| -> Vec<f64> {
        let decade = |k: i32| digits.iter().map(move |d| f64::from(*d) * 10f64.powi(k));
        (first..=last).flat_map(decade).filter(|t| (from..=to).contains(t)).collect()
    };
    let few = of(&[1, 2, 5]);
    if few.len() > 2 { few } else { of(&[1, 2, 3, 4, 5, 6, 7, 8, 9]) }
}

/// Three digits that count.
fn short(value: f64) -> String {
    if value.abs() < 1e-9 {
        return "0".into();
    }
    let digits = (2 - value.abs().log10().floor() as i32).clamp(0, 6) as usize;
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_name_round_times_and_short_values() {
        assert_eq!(ticks(0.015, 0.6), [0.02, 0.05, 0.1, 0.2, 0.5]);
        assert_eq!(ticks(0.11, 0.28), [0.2], "nothing rounder lies there");
        assert_eq!([0.0, 0.0412, 33.3, 1234.0].map(short), ["0", "0.0412", "33.3", "1234"]);
    }
}

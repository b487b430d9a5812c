//! The two plots.

use crate::pool::Pool;
use plotters::prelude::*;
use sdim::metrics::sparsification_curve;
use std::path::Path;

const SIZE: (u32, u32) = (640, 520);
const COLOURS: [RGBColor; 3] = [RGBColor(200, 80, 40), RGBColor(40, 90, 180), RGBColor(110, 110, 110)];

/// Points of a curve of sparsification.
const STEPS: usize = 100;

/// Points of one curve, and its name.
struct Curve<'a> {
    name: &'a str,
    points: Vec<(f64, f64)>,
    /// Whether its points are marked.
    marked: bool,
}

/// What is stated, against how often it came true.
pub fn reliability(path: &Path, pools: &[(&str, &Pool)]) -> anyhow::Result<()> {
    let mut curves = Vec::new();
    for (name, pool) in pools {
        let all = pool.reliability(|_| true);
        let points = all.iter().flat_map(|c| &c.bins).map(|b| (b.stated, b.observed)).collect();
        curves.push(Curve { name, points, marked: true });
    }
    curves.push(Curve { name: "perfect", points: vec![(0.0, 0.0), (1.0, 1.0)], marked: false });
    let axes = ["confidence stated", "share of pixels within 5 %"];
    draw(path, "Reliability", axes, SeriesLabelPosition::LowerRight, &curves)
}

/// Mean error of the pixels left when the most uncertain are taken away.
pub fn sparsification(path: &Path, pool: &Pool) -> anyhow::Result<()> {
    let (errors, orders) = pool.orders();
    let mut curves = Vec::new();
    for (name, order) in &orders {
        let points = sparsification_curve(errors, order, STEPS).unwrap_or_default();
        curves.push(Curve { name, points, marked: false });
    }
    let points = sparsification_curve(errors, errors, STEPS).unwrap_or_default();
    curves.push(Curve { name: "by the errors themselves", points, marked: false });
    let axes = ["share of pixels removed", "mean error of the rest by that of all"];
    draw(path, "Sparsification", axes, SeriesLabelPosition::UpperRight, &curves)
}

fn draw(
    path: &Path,
    title: &str,
    axes: [&str; 2],
    legend_at: SeriesLabelPosition,
    curves: &[Curve],
) -> anyhow::Result<()> {
    let root = SVGBackend::new(path, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .caption(title, ("sans-serif", 22))
        .margin(12)
        .x_label_area_size(44)
        .y_label_area_size(54)
        .build_cartesian_2d(0.0..1.0, 0.0..1.05)?;
    chart.configure_mesh().x_desc(axes[0]).y_desc(axes[1]).light_line_style(WHITE).draw()?;
    for (curve, colour) in curves.iter().zip(COLOURS) {
        let line = LineSeries::new(curve.points.iter().copied(), colour.stroke_width(2));
        chart
            .draw_series(line)?
            .label(curve.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
        if curve.marked {
            chart.draw_series(curve.points.iter().map(|p| Circle::new(*p, 3, colour.filled())))?;
        }
    }
    let mut legend = chart.configure_series_labels();
    legend.position(legend_at).background_style(WHITE).border_style(BLACK).draw()?;
    root.present()?;
    Ok(())
}

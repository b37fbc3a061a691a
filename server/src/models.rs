//! `ModelService`: what is served.

use std::sync::Arc;

use emp_proto::v1::{
    GetModelRequest, GetModelResponse, GetRobotRequest, GetRobotResponse, ListModelsRequest,
    ListModelsResponse, model_service_server::ModelService,
};
use tonic::{Request, Response, Status};

use crate::{catalog::Catalog, wire};

/// What is served.
pub(crate) struct Models {
    catalog: Arc<Catalog>,
}

impl Models {
    pub(crate) fn new(catalog: Arc<Catalog>) -> Self {
        Self { catalog }
    }
}

#[tonic::async_trait]
impl ModelService for Models {
    async fn list_models(
        &self,
        _: Request<ListModelsRequest>,
    ) -> Result<Response<ListModelsResponse>, Status> {
        let models = self.catalog.cards().into_iter().cloned().collect();
        Ok(Response::new(ListModelsResponse { models }))
    }

    async fn get_model(
        &self,
        request: Request<GetModelRequest>,
    ) -> Result<Response<GetModelResponse>, Status> {
        let model = self.catalog.model(&request.get_ref().name)?.clone();
        Ok(Response::new(GetModelResponse { model: Some(model) }))
    }

    async fn get_robot(
        &self,
        request: Request<GetRobotRequest>,
    ) -> Result<Response<GetRobotResponse>, Status> {
        let robot = wire::robot(self.catalog.robot(&request.get_ref().name)?);
        Ok(Response::new(GetRobotResponse { robot: Some(robot) }))
    }
}
